"""Reading of a run: episodes, columns, rows, trajectories, inputs of recordings, and the runs of a folder."""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr
import zarr
from numpy.typing import NDArray
from sklearn.metrics import r2_score
from typer.testing import CliRunner

from probe_kit._terminal import console
from probe_kit.cli import app
from probe_kit.errors import (
    ActivationsLeftOutError,
    NoProbesError,
    ProbeKitError,
    RunDamagedError,
    RunNotFoundError,
    UnknownSiteError,
    UsageError,
)
from probe_kit.extract.sources.player import SIDE
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.retention import retention_table
from probe_kit.runs import ActionErrors, Run, arrays, compare_actions, copy_run, export_run, open_run, verify_run
from probe_kit.runs.arrays import EpisodeRows, decode_bfloat16, open_array, role_mask, token_blocks
from probe_kit.runs.layout import DATASET, OTHER_ACTIONS
from probe_kit.runs.run_folders import find_runs, runs_in
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter
from probe_kit.train import load_results, train_probes
from probe_kit.train.builtin_columns import label_frame
from probe_kit.view.commands import _open_runs
from tests.support.recorded_run import ACTION, CALLS, CHUNK, EVERY, SHORT, recorded_plan, write_recorded_run
from tests.support.rehashing import rehash


@pytest.fixture
def damaged(recorded_run: Run, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(recorded_run.path, tmp_path / "run"))


def test_episodes_come_in_plan_order_with_labels_and_outcomes(recorded_run: Run) -> None:
    episodes = recorded_run.episodes
    assert len(episodes) == 24
    assert episodes["episode"].tolist() == list(range(24))
    assert set(episodes["category"]) == {"color", "shape"}
    assert (episodes.groupby("item_id")["layout"].nunique() == 2).all()
    assert (episodes.groupby("item_id")["side_correct"].nunique() == 2).all()
    assert episodes["cube_x"].between(0, 1).all()


def test_every_site_has_finite_rows_that_differ_between_episodes(recorded_run: Run) -> None:
    for stream, width in (("backbone", 96), ("expert", 64)):
        for site in recorded_run.sites(stream):
            column = recorded_run.column(site)
            assert column.shape == (24, width)
            assert column.dtype == np.float32
            assert np.isfinite(column).all()
    last = recorded_run.column(recorded_run.sites("backbone")[-1])
    assert np.abs(last - last[0]).max(axis=1)[1:].min() > 1e-4


@pytest.mark.slow
def test_pooled_views_equal_what_the_stored_tokens_give(recorded_run: Run) -> None:
    """Up to the rounding of tokens to bfloat16."""
    for site in (Site("backbone", 2), Site("expert", 3, iteration=7)):
        for role in recorded_run.views(site.stream)[2:]:
            values, mask = recorded_run.tokens(site, role.removeprefix("mean:"))
            recomputed = (values * mask[..., None]).sum(1) / mask.sum(1, keepdims=True)
            np.testing.assert_allclose(recomputed, recorded_run.column(site, role), atol=0.02)


def test_padding_tokens_are_stored_as_zeros(recorded_run: Run) -> None:
    values, mask = recorded_run.tokens(Site("backbone", 3))
    assert not mask.all()
    assert (values[~mask] == 0).all()
    assert (np.abs(values[mask]).max(axis=-1) > 0).all()


def test_bfloat16_bits_decode_exactly() -> None:
    values = torch.randn(1000).to(torch.bfloat16)
    bits = values.view(torch.int16).numpy().view(np.uint16)
    np.testing.assert_array_equal(decode_bfloat16(bits), values.float().numpy())


def test_the_page_reads_a_run_with_plain_zarr_and_json(recorded_run: Run) -> None:
    page = (Path(__file__).parents[2] / "docs" / "storage.md").read_text(encoding="utf-8")
    code = next(block for block in page.split("```python\n") if "import zarr" in block).partition("```")[0]
    assert "probe_kit" not in code
    names: dict[str, Any] = {}
    exec(code.replace('"RUN"', repr(str(recorded_run.path))), names)
    column = [row[0, 3, 0] for row in names["rows"]]
    np.testing.assert_array_equal(column, recorded_run.column(Site("backbone", 3)))
    dataset = xr.open_zarr(recorded_run.path / "data.zarr", group="backbone", consolidated=False, chunks=None)
    assert dataset["pooled"].dims == ("episode", "call", "layer", "view", "feature")


def every_array(run: Run) -> Iterator[tuple[str, Path]]:
    for path in sorted((run.path / "data.zarr").rglob("zarr.json")):
        if json.loads(path.read_bytes())["node_type"] == "array":
            yield path.parent.relative_to(run.path / "data.zarr").as_posix(), path.parent


@pytest.mark.parametrize("kind", [pytest.param("recorded_run", marks=pytest.mark.slow), "shown_run"])
def test_other_tools_read_all_of_a_finished_run_at_once(kind: str, request: pytest.FixtureRequest) -> None:
    run: Run = request.getfixturevalue(kind)
    tree = xr.open_datatree(run.path / "data.zarr", engine="zarr", consolidated=False, chunks=None)
    names = []
    for name, path in every_array(run):
        array = zarr.open_array(path, mode="r")
        assert (array.shape[0], array.attrs["episodes"]) == (len(run.episodes),) * 2
        full_array, rows = array[:], EpisodeRows(open_array(run.data, name), run.episodes["episode"].tolist())
        np.testing.assert_array_equal(full_array[run.episodes["episode"]], np.stack(list(rows)))
        np.testing.assert_array_equal(tree[name].load().values, full_array)
        names.append(name)
    assert {*run.root.arrays} <= {*names}
    for columns in (run.path / "columns.zarr").iterdir():
        xr.open_datatree(columns, engine="zarr", consolidated=False, chunks=None).load()


@pytest.mark.slow
def test_tensorstore_reads_all_of_a_finished_run_at_once(recorded_run: Run, tmp_path: Path) -> None:
    """In an environment of its own: it is none of probe_kit's."""
    python = tmp_path / "env/bin/python"
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "env"], check=True)
    installed = subprocess.run([python, "-m", "pip", "install", "-q", "tensorstore==0.1.86"], check=False)
    if installed.returncode:
        pytest.skip("tensorstore cannot be installed here")
    code = "import sys, tensorstore as ts, numpy as np\n" + (
        "array = ts.open({'driver': 'zarr3', 'kvstore': f'file://{sys.argv[1]}/'}).result()\n"
        "np.save(sys.argv[2], np.asarray(array.read().result()))\n"
    )
    for name, path in every_array(recorded_run):
        subprocess.run([python, "-c", code, path.resolve(), tmp_path / "whole.npy"], check=True)
        np.testing.assert_array_equal(
            np.load(tmp_path / "whole.npy"), zarr.open_array(path, mode="r")[:], err_msg=name
        )


def test_the_labelled_dataset_selects_by_name(recorded_run: Run) -> None:
    dataset = recorded_run.xarray()
    selected = dataset["backbone_pooled"].sel(backbone_view="mean:language").isel(call=0, backbone_layer=2)
    np.testing.assert_array_equal(selected, recorded_run.column(Site("backbone", 2), "mean:language"))
    assert dataset["category"].values.tolist() == recorded_run.episodes["category"].tolist()


@pytest.mark.parametrize(
    ("site", "view"),
    [(Site("backbone", 5), "mean"), (Site("vision", 0), "mean"), (Site("backbone", 0), "mean:state")],
)
def test_reading_an_array_that_is_not_stored_names_it(recorded_run: Run, site: Site, view: str) -> None:
    with pytest.raises(UnknownSiteError):
        recorded_run.column(site, view)


@pytest.mark.filterwarnings("ignore:.*is not sealed")
def test_a_flipped_bit_is_an_error_and_never_a_number(damaged: Path) -> None:
    chunk = next((damaged / "data.zarr/backbone/pooled/c/3").rglob("0"))
    while chunk.is_dir():
        chunk = next(chunk.iterdir())
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    shutil.rmtree(damaged / "columns.zarr")
    with pytest.raises(RunDamagedError, match=r"commits/00000003\.json"):
        open_run(damaged).column(Site("backbone", 0))


def test_a_missing_or_truncated_object_is_noticed_on_opening(damaged: Path) -> None:
    chunk = max((damaged / "data.zarr/expert/tokens/c/5").rglob("*"), key=lambda path: path.is_file())
    chunk.write_bytes(chunk.read_bytes()[:-1])
    with pytest.raises(RunDamagedError, match="were written"):
        open_run(damaged)
    chunk.unlink()
    with pytest.raises(RunDamagedError, match="is missing"):
        open_run(damaged)


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunNotFoundError, match="probe-kit extract"):
        open_run(tmp_path)


@pytest.mark.slow
def test_a_run_shows_the_first_items_of_some_categories(recorded_run: Run) -> None:
    part = recorded_run.only(["color"], 4)
    all_episodes = recorded_run.episodes
    first = list(dict.fromkeys(all_episodes.loc[all_episodes["category"] == "color", "item_id"]))[:4]
    mine = all_episodes["item_id"].isin(first).to_numpy()
    assert part.episodes["item_id"].unique().tolist() == first
    assert (part.planned, len(part.items)) == (8, 4)
    assert part.planned_items == recorded_run.planned_items  # by which its suite is found again
    for site in (Site("backbone", 2), Site("expert", 3, iteration=7)):
        np.testing.assert_array_equal(part.column(site), recorded_run.column(site)[mine])
        np.testing.assert_array_equal(part.tokens(site)[1], recorded_run.tokens(site)[1][mine])
    assert part.control_steps.tolist() == recorded_run.control_steps[mine].tolist()
    assert (part.judged("disc")["correct"].to_numpy() == recorded_run.judged("disc")["correct"][mine]).all()
    assert part.all_wordings is part
    assert part.only(items=2).episodes["item_id"].unique().tolist() == first[:2]
    assert recorded_run.only() is recorded_run


@pytest.mark.parametrize(
    ("categories", "items", "why"),
    [
        (["colour"], None, "unknown category 'colour'"),
        ([], None, "no category selected"),
        (None, 0, "items is 0"),
        (None, 14, r"plans 6 items of 'color'; give a number from 1 to 6"),
        (["shape"], 3, "role-exchanged twins"),
    ],
)
def test_a_selection_that_a_run_does_not_hold_is_refused(
    recorded_run: Run, categories: list[str] | None, items: int | None, why: str
) -> None:
    with pytest.raises(ProbeKitError, match=why):
        recorded_run.only(categories, items)


@pytest.mark.slow
def test_a_part_of_a_run_has_probes_of_its_own(little_runs: Path, tmp_path: Path) -> None:
    run = open_run(shutil.copytree(little_runs / "run", tmp_path / "run"))
    part, stored = run.only(items=10), load_results(run).key
    with pytest.raises(NoProbesError, match="other episodes"):
        load_results(part)
    part_probes = train_probes(part, permutations=0)
    assert (load_results(part).key, load_results(run).key) == (part_probes.key, stored)
    assert len(part_probes.curves["color", "mean"].episodes) == 20


TOKENS, WIDTH = 7, 3
SPANS = [
    [("image", 0, 2), ("language", 2, 5), ("padding", 5, 7)],
    [("padding", 0, 1), ("language", 1, 3), ("image", 3, 7)],
]
"""Spans of two episodes: role, first position and the one behind the last."""


def bfloat16(values: NDArray[np.float32]) -> NDArray[np.uint16]:
    """The upper half of the bits of float32."""
    return (values.view(np.uint32) >> 16).astype(np.uint16)


@pytest.fixture
def stored() -> tuple[EpisodeRows, NDArray[np.float32]]:
    """Three planned episodes of one call and two layers, of which 0 and 2 are committed; and their values.

    Whole numbers below 256 have an exact bfloat16. The first position of every episode is NaN, the last infinite.
    """
    values = np.arange(3 * 1 * 2 * TOKENS * WIDTH, dtype=np.float32).reshape(3, 1, 2, TOKENS, WIDTH) + 1
    values[..., 0, :], values[..., -1, :] = np.nan, np.inf
    array = zarr.create_array(zarr.storage.MemoryStore(), data=bfloat16(values))
    return EpisodeRows(array, [0, 2]), values[[0, 2]]


@pytest.mark.parametrize("block", [1, 2, 3, TOKENS, 100])
@pytest.mark.parametrize("role", ["language", "image", None])
def test_every_token_of_a_role_comes_once_and_zeros_stand_for_all_others(
    stored: tuple[EpisodeRows, NDArray[np.float32]], role: str | None, block: int
) -> None:
    rows, values = stored
    belongs = np.array(
        [
            [next(name for name, start, stop in spans if start <= at < stop) for at in range(TOKENS)]
            for spans in SPANS
        ]
    )
    expected = belongs != "padding" if role is None else belongs == role
    mask = role_mask(SPANS, TOKENS, role)
    np.testing.assert_array_equal(mask, expected)
    filled = np.zeros((2, TOKENS, WIDTH), np.float32)
    for part in token_blocks(rows, (0, 1), mask, block):
        np.testing.assert_array_equal(part.mask, expected[:, part.start : part.start + block])
        filled[:, part.start : part.start + block] += part.values
    np.testing.assert_array_equal(filled, np.where(expected[..., None], values[:, 0, 1], 0))


@pytest.fixture
def copy(recorded_run: Run, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded_run.path, tmp_path / "run"))


def test_every_episode_keeps_its_trajectory(recorded_run: Run) -> None:
    episodes = recorded_run.episodes
    assert len(recorded_run.trajectories) == len(episodes)
    for position, trajectory in enumerate(recorded_run.trajectories):
        row = episodes.iloc[position]
        assert trajectory.steps == row["steps"] == 4
        np.testing.assert_allclose(trajectory.cube[-1, :2], (row["cube_x"], row["cube_y"]), atol=1e-6)
        assert trajectory.held[-1] == row["is_grasped"]
        assert np.isfinite(trajectory.frames[1:]).all()
    last = str(episodes["episode_id"].iloc[-1])
    np.testing.assert_array_equal(recorded_run.trajectory(last).frames, recorded_run.trajectory(23).frames)


def test_a_trajectory_takes_a_few_kilobytes(recorded_run: Run) -> None:
    for commit in recorded_run.commits():
        sizes = [size for key, (size, *_) in commit.objects.items() if key.startswith("trajectory/")]
        assert len(sizes) == 1
        assert sizes[0] < 4000


def test_the_instruction_is_kept_as_the_policy_was_delivered_it(recorded_run: Run, pi0_tiny: Pi0) -> None:
    for position, instruction in enumerate(recorded_run.episodes["instruction"]):
        tokens, mask = pi0_tiny.tokenise([instruction])
        assert recorded_run.instruction_ids(position) == tuple(tokens[0][mask[0]].tolist())


def test_an_episode_that_is_not_there_is_named(recorded_run: Run) -> None:
    for episode in ("color-9999:o", 24, -1):
        with pytest.raises(UsageError, match="24, from 'a2a"):
            recorded_run.trajectory(episode)


def test_a_changed_bit_is_found_on_reading_and_by_verification(copy: Path) -> None:
    chunk = copy / "data.zarr/trajectory/c/3/0/0"
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    run = open_run(copy)
    run.trajectory(2)
    with pytest.raises(RunDamagedError, match=r"trajectory/c/3/0/0 has other bytes"):
        run.trajectory(3)
    problems = verify_run(copy, deep=True).problems
    assert any("trajectory/c/3/0/0" in problem for problem in problems)


@pytest.mark.slow
@pytest.mark.parametrize("together", [1, 5, 99])
def test_trajectories_that_are_read_together_are_those_that_are_read_alone(
    recorded_run: Run, copy: Path, monkeypatch: pytest.MonkeyPatch, together: int
) -> None:
    array = zarr.open_array(str(copy / "data.zarr"), path="trajectory", mode="r")
    monkeypatch.setattr(arrays, "_BLOCK_BYTES", together * array[0].nbytes)
    assert len(list(recorded_run.trajectories)) == 24
    for position, trajectory in enumerate(recorded_run.trajectories):
        np.testing.assert_array_equal(trajectory.frames, recorded_run.trajectories[position].frames)
    chunk = copy / "data.zarr/trajectory/c/17/0/0"
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"x")
    reading = iter(open_run(copy).trajectories)
    assert [next(reading).steps for _ in range(17)] == [4] * 17
    with pytest.raises(RunDamagedError, match="trajectory/c/17/0/0"):
        next(reading)


def test_channels_of_another_version_are_refused(copy: Path) -> None:
    array = zarr.open_array(copy / "data.zarr/trajectory", mode="r+")
    array.attrs["channels"] = [str(name).replace("held", "grip") for name in array.attrs["channels"]]
    with pytest.raises(RunDamagedError, match=r"trajectory/zarr\.json has"):
        open_run(copy)
    rehash(copy)
    with pytest.raises(RunDamagedError, match=r"other channels than tool"):
        _ = open_run(copy).trajectories


@pytest.fixture
def folder(labelled_run: Path, tmp_path: Path) -> Path:
    for name in ("b", "deep/a"):
        shutil.copytree(labelled_run, tmp_path / "runs" / name)
    return tmp_path / "runs"


def test_runs_are_found_at_any_depth_in_the_order_of_their_paths(folder: Path) -> None:
    assert find_runs(folder) == [folder / "b", folder / "deep" / "a"]
    assert find_runs(folder / "b") == [folder / "b"], "a run is the only one of its own folder"
    assert runs_in(folder, deep=False) == [folder / "b"]


def test_a_folder_that_holds_no_run_is_refused(folder: Path) -> None:
    (folder / "empty").mkdir()
    with pytest.raises(UsageError, match="there is no run below"):
        find_runs(folder / "empty")
    with pytest.raises(UsageError, match="is no folder of this machine"):
        find_runs(folder / "none")


def test_the_list_names_every_run_and_the_one_that_cannot_be_read(folder: Path) -> None:
    (folder / "broken").mkdir()
    (folder / "broken" / "run.json").write_text("{", encoding="utf-8")
    result = CliRunner().invoke(app, ["run", "show", str(folder), "--json"])
    assert result.exit_code == 0, result.output
    lines = json.loads(result.stdout)
    assert [line["run"] for line in lines] == ["b", "broken", "deep/a"]
    assert "error" in lines[1]
    assert lines[0]["episodes"] == lines[2]["episodes"] > 0
    printed = CliRunner().invoke(app, ["run", "show", str(folder)])
    assert "deep/a" in printed.stdout
    assert "broken cannot be read" in printed.stderr


def test_names_of_runs_can_be_copied_from_a_narrow_terminal(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "light/base/plain-0123456789"
    (folder / name).parent.mkdir(parents=True)
    (folder / "b").rename(folder / name)
    monkeypatch.setattr(console.out, "_width", 60)
    assert name in CliRunner().invoke(app, ["run", "show", str(folder)]).stdout


def test_the_viewer_opens_all_runs_of_a_folder(folder: Path) -> None:
    assert [run.location.name for run in _open_runs([str(folder)], True)] == ["b", "a"]


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
    ("requirement", "refused"),
    [
        ("retention table", lambda run: retention_table([run])),
        ("probe of the side .side.correct.", train_probes),
    ],
)
def test_a_run_without_scene_or_outcome_refuses_by_name_what_needs_them(
    shown_run: Run, requirement: str, refused: object
) -> None:
    assert callable(refused)
    with pytest.raises(UsageError, match=rf"shows recordings \(kitchen#.*{requirement} is not possible"):
        refused(shown_run)


def test_an_export_has_the_columns_that_the_run_has(shown_run: Run, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(export_run(shown_run.path, "parquet", tmp_path / "run.parquet"))
    assert {"episode_id", "category", "outcome", "inference", "frame", "site", "vector"} <= set(table.column_names)
    assert "layout" not in table.column_names


@pytest.fixture(scope="module")
def errors(shown_run: Run) -> ActionErrors:
    return compare_actions(shown_run)


def actions(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """(n, chunk, D) recorded and predicted, of the shown frames."""
    assert run.inputs is not None
    recorded, predicted = (run.inputs.read(kind).astype(np.float64) for kind in ("action", "prediction"))
    is_finite = np.isfinite(recorded[:, :, 0, 0])
    return recorded[is_finite], predicted[is_finite]


def test_the_error_of_a_number_is_what_its_r2_says(shown_run: Run, errors: ActionErrors) -> None:
    """In deviations of what was recorded, the squared error is 1 − R²: the mean recorded action has 1."""
    recorded, predicted = actions(shown_run)
    table = errors.by_number.set_index("number")
    assert list(table.index) == ["dx", "grip"]
    for column, name in enumerate(table.index):
        expected = 1 - r2_score(recorded[:, 0, column], predicted[:, 0, column])
        assert table.loc[name, "first"] ** 2 == pytest.approx(expected)
        assert table.loc[name, "deviation"] == pytest.approx(recorded[:, 0, column].std())
        squares = ((predicted - recorded)[:, :, column] / recorded[:, 0, column].std()) ** 2
        assert table.loc[name, "chunk"] == pytest.approx(np.sqrt(squares.mean()))


def test_frames_and_episodes_have_errors_of_their_own(shown_run: Run, errors: ActionErrors) -> None:
    frames, episodes = errors.by_frame, errors.by_episode
    assert len(frames) == 12 * CALLS - 1
    assert list(frames["frame"][:CALLS]) == [EVERY * call for call in range(CALLS)]
    recorded, predicted = actions(shown_run)
    scaled = (predicted - recorded) / recorded[:, 0].std(axis=0)
    np.testing.assert_allclose(frames["first"], np.sqrt((scaled[:, 0] ** 2).mean(axis=1)))
    np.testing.assert_allclose(frames["chunk"], np.sqrt((scaled**2).mean(axis=(1, 2))))
    assert episodes["frames"].tolist() == [CALLS - (number == SHORT) for number in range(12)]
    episode_errors = frames[frames["source_episode"] == 3]["first"]
    assert episodes["first"][3] == pytest.approx(np.sqrt((episode_errors**2).mean()))


def test_the_error_of_a_frame_is_a_label(shown_run: Run, errors: ActionErrors) -> None:
    np.testing.assert_allclose(label_frame(shown_run)["dataset.action_error"], errors.by_frame["first"])


def test_steps_behind_the_end_of_a_recording_and_constant_numbers_count_nowhere(errors: ActionErrors) -> None:
    cut = errors.errors.copy()
    cut[0, 0, 1:] = np.nan
    cut_errors = replace(errors, errors=cut, deviations=np.array([errors.deviations[0], 0.0]))
    assert cut_errors.by_frame["chunk"][0] == pytest.approx(cut_errors.by_frame["first"][0])
    assert np.isnan(cut_errors.by_number["first"][1])
    assert np.isfinite(cut_errors.by_frame["first"]).all()


@pytest.mark.parametrize(
    ("inputs", "reason", "message"),
    [
        ({"action": [CHUNK, ACTION + 1]}, None, "the policy predicts 2 numbers, the data set has 3"),
        ({}, "recorded actions lie outside the statistics", "not compared: recorded actions lie outside"),
        ({"action": None}, None, "the data set has no actions"),
    ],
)
def test_actions_that_are_not_the_same_numbers_are_not_compared(
    tmp_path: Path, inputs: dict[str, list[int] | None], reason: str | None, message: str
) -> None:
    plan = recorded_plan(3)
    data_set, recording = plan.identity[DATASET], plan.selection["recording"]
    shapes = {name: shape for name, shape in {**data_set["inputs"], **inputs}.items() if shape is not None}
    plan = replace(
        plan,
        identity={DATASET: {**data_set, "inputs": shapes}},
        selection={"recording": {**recording, OTHER_ACTIONS: reason}},
    )
    settings = {
        "model": "shown", "weights_sha256": "0" * 64, "random_weights": False, "captured_calls": CALLS,
        "tokens": "pooled", "codec": "zstd", "seed": 0, "capture_only": True, **plan.identity,
    }  # fmt: skip
    RunWriter(locate(tmp_path / "run"), plan, settings)
    with pytest.raises(UsageError, match=message):
        compare_actions(open_run(tmp_path / "run", allow_partial=True))


def test_a_run_of_scenes_has_no_recorded_actions(labelled_run: Path) -> None:
    with pytest.raises(UsageError, match="no recorded actions"):
        compare_actions(open_run(labelled_run))


@pytest.mark.slow
def test_the_command_prints_a_line_per_number_and_json_every_episode(
    tmp_path: Path,
) -> None:
    run = write_recorded_run(tmp_path / "run", 3)
    command = ["run", "show", str(run.path), "--action-errors"]
    output = CliRunner().invoke(app, command).stdout
    assert "dx" in output
    assert "12 frames" in output
    answer = json.loads(CliRunner().invoke(app, [*command, "--json"]).stdout)
    assert [row["number"] for row in answer["numbers"]] == ["dx", "grip"]
    assert [row["source_episode"] for row in answer["episodes"]] == [0, 1, 2]


def test_a_run_without_a_setting_that_all_have_is_named_and_hides_no_other_run(
    little_runs: Path, tmp_path: Path
) -> None:
    plan = recorded_plan(3)
    settings = {"model": "shown", "captured_calls": CALLS, "tokens": "pooled", "codec": "zstd", "seed": 0}
    RunWriter(locate(tmp_path / "other"), plan, {**settings, **plan.identity})
    shutil.copytree(little_runs / "run", tmp_path / "run")
    with pytest.raises(RunDamagedError, match="does not store the setting 'random_weights'"):
        _ = open_run(tmp_path / "other", allow_partial=True).random_weights
    printed = CliRunner().invoke(app, ["run", "show", str(tmp_path)])
    assert printed.exit_code == 0, printed.output
    assert "setting" in printed.output
    assert "little" in printed.output
