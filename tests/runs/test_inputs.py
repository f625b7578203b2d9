"""What a run on recordings stores beside its activations, and what it refuses because nothing acted."""

from pathlib import Path

import numpy as np
import pytest

from probe_kit.errors import ActivationsLeftOutError, RunDamagedError, UsageError
from probe_kit.extract.sources.player import SIDE
from probe_kit.retention import retention_table
from probe_kit.runs import Run, copy_run, export_run, verify_run
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter
from probe_kit.train import train_probes
from tests.support.recorded_run import CALLS, EVERY, recorded_plan, write_recorded_run


def test_inputs_are_read_as_they_were_shown_and_nan_behind_the_last_frame(shown_run: Run) -> None:
    assert shown_run.inputs is not None
    state, pixels = shown_run.inputs.read("state"), shown_run.inputs.read("pixels")
    assert state.shape == (12, CALLS, 3)
    assert pixels.shape == (12, CALLS, 1, SIDE, SIDE, 3)
    assert pixels.dtype == np.uint8
    assert np.isfinite(state[:-1]).all()
    assert np.isnan(state[-1, -1]).all(), "the last episode has one frame less"
    np.testing.assert_allclose(shown_run.inputs.column("timestamp")[0], np.arange(CALLS) * EVERY / 5.0)
    np.testing.assert_array_equal(shown_run.control_steps[0], np.arange(CALLS) * EVERY)


def test_a_run_on_recordings_is_verified_to_the_last_byte(shown_run: Run, tmp_path: Path) -> None:
    audit = verify_run(shown_run.path, deep=True)
    assert audit.ok
    assert not audit.strays
    run = write_recorded_run(tmp_path / "run", 3)
    damaged = tmp_path / "run" / "data.zarr" / "inputs" / "state" / "c" / "0" / "0" / "0"
    raw = bytearray(damaged.read_bytes())
    raw[len(raw) // 2] ^= 1
    damaged.write_bytes(raw)
    assert not verify_run(run.path, deep=True).ok
    assert run.inputs is not None
    with pytest.raises(RunDamagedError, match="inputs/state"):
        run.inputs.read("state")


def test_a_copy_leaves_the_recorded_pictures_and_states_out(shown_run: Run, tmp_path: Path) -> None:
    copied = copy_run(shown_run.path, tmp_path / "copy")
    assert not list((tmp_path / "copy" / "data.zarr" / "inputs").rglob("c/*"))
    with pytest.raises(ActivationsLeftOutError, match="no inputs"):
        _ = copied.inputs


def test_the_run_says_what_it_is_of(shown_run: Run) -> None:
    assert shown_run.recorded
    assert shown_run.suite == "kitchen#000000000000"
    assert "CAPTURE ONLY" in repr(shown_run)
    assert list(shown_run.episodes["source_episode"]) == list(range(12))
    assert shown_run.xarray()["backbone_pooled"].sizes["episode"] == 12
    assert not [column for column in ("layout", "side_correct", "side_placed") if column in shown_run.episodes]


def test_it_grows_by_further_episodes_and_keeps_those_it_has(tmp_path: Path) -> None:
    few = write_recorded_run(tmp_path / "run", 3)
    stored = few.root.own_settings
    more = RunWriter(locate(tmp_path / "run"), recorded_plan(5), stored)
    assert len(more.root.plan) == 5


@pytest.mark.parametrize(
    ("wanted", "refused"),
    [
        ("retention table", lambda run: retention_table([run])),
        ("probe of the side .side.correct.", train_probes),
    ],
)
def test_what_needs_a_scene_or_an_outcome_is_refused_by_name(shown_run: Run, wanted: str, refused: object) -> None:
    assert callable(refused)
    with pytest.raises(UsageError, match=rf"shows recordings \(kitchen#.*{wanted} is not possible"):
        refused(shown_run)


def test_an_export_has_the_columns_that_the_run_has(shown_run: Run, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(export_run(shown_run.path, "parquet", tmp_path / "run.parquet"))
    assert {"episode_id", "category", "outcome", "inference", "frame", "site", "vector"} <= set(table.column_names)
    assert "layout" not in table.column_names
