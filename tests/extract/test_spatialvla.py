"""A policy that sees depth, through environment, store, probes and tables, beside the other families."""

from pathlib import Path

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import SettingsMismatchError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks import Site
from probe_kit.retention import retention_table
from probe_kit.suite import Suite
from probe_kit.train import train_probes
from tests.support.prismatic_checkpoints import write_checkpoint as write_openvla
from tests.support.spatialvla_checkpoints import write_checkpoint

pytestmark = pytest.mark.filterwarnings("ignore:the model put out tokens")


@pytest.fixture(scope="module")
def settings(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> ExtractSettings:
    return ExtractSettings(
        "spatialvla",
        str(write_checkpoint(tmp_path_factory.mktemp("spatialvla"))),
        suite=small_suite.folder,
        categories=("color",),
        items=12,
        scene=SceneSpec(max_steps=1),
        env_workers=0,
    )


@pytest.mark.slow
def test_three_families_stand_in_one_table(settings: ExtractSettings, tmp_path: Path) -> None:
    openvla = settings.changed(
        model="openvla",
        checkpoint=str(write_openvla(tmp_path / "openvla")),
        options={"tokenizer": "bytes"},
    )
    tiny = settings.changed(model="pi0-tiny", checkpoint=None)
    runs = [extract_run(one, tmp_path / f"run-{one.model}") for one in (settings, openvla, tiny)]
    run = runs[0]
    assert list(run.streams) == ["backbone", "action"]
    assert len(run.sites("action")) == 4 * 3
    assert run.certificate["hooks_on_equals_hooks_off"]
    assert run.settings["policy"]["camera"] == "scene"
    for site, views in ((Site("backbone", 2), ("mean", "mean:image.primary", "mean:language")),
                        (Site("action", 3, iteration=2), ("mean", "mean:action"))):  # fmt: skip
        for view in views:
            column = np.asarray(run.column(site, view))
            assert column.shape == (24, 32)
            assert np.isfinite(column).all()
            assert column.std(axis=0).max() > 0
    for one in runs:
        train_probes(one, permutations=1, jobs=1)
    rows = retention_table(runs).rows
    assert [row.run.model for row in rows] == ["spatialvla", "openvla", "pi0-tiny"]
    assert [row.run.action_stream for row in rows] == ["action", "action", "expert"]
    assert all(row.success.n_items == 12 for row in rows)


@pytest.mark.slow
def test_another_camera_is_another_run(settings: ExtractSettings, tmp_path: Path) -> None:
    small = settings.changed(items=2)
    extract_run(small, tmp_path / "run")
    with pytest.raises(SettingsMismatchError, match=r"policy\.camera: stored 'scene', asked 'default'"):
        extract_run(small.changed(options={"camera": "default"}), tmp_path / "run")
