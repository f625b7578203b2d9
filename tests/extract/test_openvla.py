"""A policy without an action expert, through environment, store and columns."""

from pathlib import Path

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import SettingsMismatchError, UsageError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks import Site
from probe_kit.suite import Suite
from tests.support.prismatic_checkpoints import config_values, write_checkpoint

pytestmark = pytest.mark.filterwarnings("ignore:the model put out tokens")


@pytest.fixture(scope="module")
def settings(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> ExtractSettings:
    known = config_values()["norm_stats"] | {"mine": config_values()["norm_stats"]["bridge_orig"]}
    folder = write_checkpoint(tmp_path_factory.mktemp("openvla"), norm_stats=known)
    return ExtractSettings(
        "openvla",
        str(folder),
        suite=small_suite.folder,
        categories=("color",),
        items=2,
        scene=SceneSpec(max_steps=2),
        env_workers=0,
        options={"tokenizer": "bytes", "unnorm_key": "bridge_orig"},
        tokens="all",
    )


@pytest.mark.slow
def test_a_run_has_the_two_streams_and_every_token_has_its_role(settings: ExtractSettings, tmp_path: Path) -> None:
    run = extract_run(settings, tmp_path / "run")
    assert list(run.streams) == ["backbone", "action"]
    assert len(run.sites("action")) == 3 * 7
    assert run.certificate["hooks_on_equals_hooks_off"]
    assert run.settings["policy"]["unnorm_key"] == "bridge_orig"
    for site, views in ((Site("backbone", 2), ("mean", "mean:image.primary", "mean:language")),
                        (Site("action", 2, iteration=6), ("mean", "mean:action"))):  # fmt: skip
        for view in views:
            column = np.asarray(run.column(site, view))
            assert column.shape == (4, 32)
            assert np.isfinite(column).all()
            assert column.std(axis=0).max() > 0


@pytest.mark.slow
def test_other_units_are_another_run(settings: ExtractSettings, tmp_path: Path) -> None:
    extract_run(settings, tmp_path / "run")
    other = settings.changed(options={"tokenizer": "bytes", "unnorm_key": "mine"})
    with pytest.raises(SettingsMismatchError, match=r"policy\.unnorm_key: stored 'bridge_orig', asked 'mine'"):
        extract_run(other, tmp_path / "run")


def test_a_vision_language_model_has_no_episodes(settings: ExtractSettings, tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path / "vlm", model_type="prismatic")
    with pytest.raises(UsageError, match="does not act"):
        extract_run(settings.changed(model="prismatic", checkpoint=str(folder)), tmp_path / "run")
