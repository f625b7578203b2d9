"""A policy that can say that it put out no action: environment, store, probes, one table with another family."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import SettingsMismatchError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks import Site
from probe_kit.retention import retention_table
from probe_kit.runs import Run
from probe_kit.suite import Suite
from probe_kit.train import train_probes
from tests.support.magma_checkpoints import write_checkpoint

pytestmark = pytest.mark.slow

STEPS = 2


def settings(
    model: str, suite: Suite, checkpoint: Path | None = None, items: int = 4, **more: Any
) -> ExtractSettings:
    if model == "magma":
        more["options"] = {"unnorm_key": "bridge_orig", **more.get("options", {})}
    return ExtractSettings(
        model,
        None if checkpoint is None else str(checkpoint),
        suite=suite.folder,
        categories=("color",),
        items=items,
        scene=SceneSpec(max_steps=STEPS),
        env_workers=0,
        **more,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("magma"))


@pytest.fixture(scope="module")
def acting(small_suite: Suite, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return extract_run(settings("magma", small_suite, folder, batch=2), tmp_path_factory.mktemp("runs") / "acting")


@pytest.fixture(scope="module")
def wordy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights that put out anything but actions."""
    return write_checkpoint(tmp_path_factory.mktemp("talking"), steered=False)


@pytest.fixture(scope="module")
def talking(small_suite: Suite, wordy: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    chosen = settings("magma", small_suite, wordy, tokens="all")
    return extract_run(chosen, tmp_path_factory.mktemp("runs") / "talking")


def test_a_run_has_both_streams_and_every_role(acting: Run) -> None:
    assert list(acting.streams) == ["backbone", "action"]
    assert len(acting.sites("action")) == 4 * 7
    assert acting.certificate["hooks_on_equals_hooks_off"]
    views = ("mean", "last", "mean:image.primary", "mean:separator", "mean:language")
    for site, wanted in ((Site("backbone", 3), views), (Site("action", 3, iteration=6), ("mean", "mean:action"))):
        for view in wanted:
            column = np.asarray(acting.column(site, view))
            assert column.shape == (8, 64)
            assert np.isfinite(column).all()
            assert column.std(axis=0).max() > 0


def test_steps_without_an_action_are_counted_per_episode(acting: Run, talking: Run) -> None:
    assert acting.episodes["inferences"].tolist() == [STEPS] * 8
    assert acting.episodes["flagged_steps"].tolist() == [0] * 8
    assert talking.episodes["flagged_steps"].tolist() == [STEPS] * 8
    assert (talking.episodes["outcome"] == "oob").all()


def test_tokens_are_stored_by_role(talking: Run) -> None:
    """256 pixels make 2 x 2 crops of 64: a map of 4 x 4 places and a separator behind each of its rows."""
    site = Site("backbone", 0)
    for role, count in (("image", 16), ("separator", 4)):
        values, mask = talking.tokens(site, role=role)
        assert mask.sum(axis=1).tolist() == [count] * 8
        assert np.abs(values[mask]).max() > 0


def test_protocol_and_units_are_part_of_a_runs_identity(acting: Run, small_suite: Suite, folder: Path) -> None:
    policy = acting.settings["policy"]
    assert (policy["unnorm_key"], policy["shrink"], policy["prompt"]) == ("bridge_orig", "256", "magma")
    for options in ({"shrink": "0"}, {"prompt": "act2answer"}, {"temperature": "0.7"}):
        other = settings("magma", small_suite, folder, batch=2, options=options)
        with pytest.raises(SettingsMismatchError, match=rf"policy\.{next(iter(options))}"):
            extract_run(other, Path(str(acting.location)))


@pytest.mark.slow
def test_it_stands_in_one_table_beside_another_family_with_its_flagged_steps(
    folder: Path, wordy: Path, small_suite: Suite, tmp_path: Path
) -> None:
    chosen = (("magma", folder), ("magma", wordy), ("pi0-tiny", None))
    runs = [
        extract_run(settings(model, small_suite, checkpoint, items=12), tmp_path / str(number))
        for number, (model, checkpoint) in enumerate(chosen)
    ]
    for run in runs:
        train_probes(run, permutations=0)
    table = retention_table(runs)
    rows = {row.run.location: row for row in table.rows if row.category == "color" and row.view == "mean"}
    shares = [rows[str(run.location)].success.share_invalid_action for run in runs]
    assert shares == [0, 1, None]
    assert [rows[str(run.location)].run.action_stream for run in runs] == ["action", "action", "expert"]
    assert all(rows[str(run.location)].backbone.score is not None for run in runs)
    text = table.to_markdown()
    assert "invalid actions %" in text
    assert "100.0" in text
