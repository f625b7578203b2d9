"""Rows that arrive one by one: each is planned by a record of its own, and counts once it is committed."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import RunDamagedError, RunIncompleteError, SettingsMismatchError
from probe_kit.runs import open_run
from probe_kit.runs.plan import Plan, Prefix, Row, plan_key
from probe_kit.runs.store import locate
from probe_kit.runs.verify import verify_run
from probe_kit.runs.writer import EpisodeRecord, RunWriter

INPUTS = {"prediction": [4, 2], "picture.base": [6, 5, 3]}
SETTINGS: dict[str, Any] = {
    "model": "none", "captured_calls": 2, "tokens": "pooled", "codec": "zstd", "random_weights": False,
    "weights_sha256": None, "seed": 0, "capture_only": True,
    "dataset": {
        "kind": "served", "meta_blake2b": "0" * 32, "cameras": [], "inputs": INPUTS, "columns": [], "names": {},
    },
}  # fmt: skip


def writer(folder: Path) -> RunWriter:
    selection = {"recording": {"name": "rows", "episodes": []}}
    opened = RunWriter(locate(folder), Plan((), (), 0, {}, selection), SETTINGS)
    opened.begin()
    return opened


def row(name: str) -> Row:
    columns = {
        "episode_id": name, "item_id": name, "category": "all", "group_id": "g", "instruction": "put it",
        "content_blake2b": "0" * 32, "source_episode": 0, "first_frame": 0, "frame_step": 1, "frames": 2,
        "policy_seed": 1, "recorded_frames": 2,
    }  # fmt: skip
    return Row(-1, columns)


def add(opened: RunWriter, name: str, picture: int = 0) -> int:
    planned = opened.add(row(name))
    pictures = np.full((1, 6, 5, 3), picture, np.uint8)
    inputs = {"prediction": np.zeros((2, 4, 2), np.float32), "picture.base": pictures}
    record = EpisodeRecord(planned, {"outcome": "success"}, {}, [{}, {}], control_steps=(0, 1), inputs=inputs)
    opened.write(record)
    return planned.index


def test_rows_of_two_writers_get_numbers_in_the_order_of_their_arrival(tmp_path: Path) -> None:
    first = writer(tmp_path / "run")
    assert add(first, "a", 7) == 0
    second = writer(tmp_path / "run")
    assert [add(second, "b"), add(first, "c"), add(second, "d", 9)] == [1, 2, 3]
    run = open_run(tmp_path / "run")
    assert run.episodes[["episode", "episode_id"]].to_numpy().tolist() == [[0, "a"], [1, "b"], [2, "c"], [3, "d"]]
    assert run.inputs is not None
    pictures = run.inputs.read("picture.base")
    assert pictures.dtype == np.uint8
    assert pictures[:, 0, 0, 0, 0].tolist() == [7, 0, 0, 9]
    assert not pictures[:, 1].any()  # an inference that was not made
    audit = verify_run(tmp_path / "run", deep=True)
    assert (audit.problems, audit.strays) == ((), ())


def test_a_row_without_a_commit_is_planned_only_and_an_id_comes_once(tmp_path: Path) -> None:
    opened = writer(tmp_path / "run")
    add(opened, "a")
    opened.add(row("b"))
    with pytest.raises(SettingsMismatchError, match="an episode 'a' already"):
        opened.add(row("a"))
    with pytest.raises(RunIncompleteError, match=r"1 of 2 episodes.*Clients played them"):
        open_run(tmp_path / "run")
    assert open_run(tmp_path / "run", allow_partial=True).episodes["episode_id"].tolist() == ["a"]
    again = writer(tmp_path / "run")
    assert add(again, "c") == 2


@pytest.mark.parametrize("lost", [0, 1])
def test_a_plan_record_that_is_lost_is_damage(tmp_path: Path, lost: int) -> None:
    opened = writer(tmp_path / "run")
    for name in "abc":
        add(opened, name)
    (tmp_path / "run" / plan_key(lost)).unlink()
    with pytest.raises(RunDamagedError, match=plan_key(lost).replace(".", r"\.")):
        open_run(tmp_path / "run")


def test_a_plan_that_grows_row_by_row_keeps_the_shorter_ones_as_they_were() -> None:
    first = Prefix.of([1, 2])
    second = first.extend([3])
    other, third = first.extend([9]), second.extend([4, 5])
    assert (list(first), list(second), list(third), list(other)) == ([1, 2], [1, 2, 3], [1, 2, 3, 4, 5], [1, 2, 9])
    assert (second[-1], second[1:], len(second), bool(Prefix.of([]))) == (3, [2, 3], 3, False)
    assert second == [1, 2, 3] != third
    with pytest.raises(IndexError):
        second[3]
