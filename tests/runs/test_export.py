"""Exports for other tools, and copies without activations."""

import hashlib
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from safetensors import safe_open

from probe_kit.errors import (
    ActivationsLeftOutError,
    MissingExtraError,
    RunDamagedError,
    UnknownSiteError,
    UsageError,
)
from probe_kit.hooks.contract.sites import Site
from probe_kit.retention import retention_table
from probe_kit.runs import Run, copy_run, export_run, open_run, seal, verify_run
from probe_kit.runs.export import _chunk_below
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import Suite
from tests.support.little_run import little_plan, little_settings

SITE = Site("expert", 3, iteration=7)
BACKBONE = Site("backbone", 1)
pytest.importorskip("pyarrow", reason="pyarrow is not installed")


def rows_of(run: Run) -> dict[str, int]:
    return {name: row for row, name in enumerate(run.episodes["episode_id"])}


def bits_of(run: Run, site: Site) -> NDArray[np.uint16]:
    """(E, T, D) the bits that the store holds of the first inference."""
    rows = run.rows(site.stream, "tokens")
    return np.stack([rows.read(row, (0, *run.stored(site.stream).at(site))) for row in range(len(rows))])


def test_parquet_holds_a_row_per_pooled_vector(labelled_run: Path, tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    run = open_run(labelled_run)
    out = export_run(labelled_run, "parquet", tmp_path / "run.parquet", sites=["backbone.01"])
    assert json.loads(pq.read_schema(out).metadata[b"probe_kit"])["settings_sha256"] == run.settings_sha256
    table = pd.read_parquet(out)
    assert set(table["site"]) == {str(BACKBONE)}
    assert (
        len(table)
        == sum(run.reached(call).sum() for call in range(run.captured_calls))
        == 4 * len(run.episodes) - 2
    )
    rows = table["episode_id"].map(rows_of(run)).to_numpy()
    assert table["group_id"].tolist() == run.episodes["group_id"].iloc[rows].tolist()
    assert table["control_step"].tolist() == run.control_steps[rows, table["inference"]].tolist()
    assert table["token"].isna().all()
    for call, vectors in table.groupby("inference"):
        expected = run.column(BACKBONE, "mean", int(call))[vectors["episode_id"].map(rows_of(run))]
        np.testing.assert_array_equal(np.stack(vectors["vector"]), expected)


@pytest.mark.slow
def test_parquet_holds_a_row_per_token_of_a_role(recorded_run: Run, tmp_path: Path) -> None:
    out = export_run(
        recorded_run.path, "parquet", tmp_path / "run", sites=["backbone.01.residual"], view="tokens:image"
    )
    table = pd.read_parquet(out)
    values, mask = recorded_run.tokens(BACKBONE, "image")
    assert len(table) == mask.sum()
    assert {role.partition(".")[0] for role in table["role"]} == {"image"}
    rows = table["episode_id"].map(rows_of(recorded_run)).to_numpy()
    np.testing.assert_array_equal(np.stack(table["vector"]), values[rows, table["token"].to_numpy(int)])


@pytest.mark.slow
def test_recordings_keep_episode_and_frame_of_their_data_set(shown_run: Run, tmp_path: Path) -> None:
    table = pd.read_parquet(export_run(shown_run.path, "parquet", tmp_path / "run.parquet", sites=["backbone.00"]))
    rows = table["episode_id"].map(rows_of(shown_run)).to_numpy()
    assert table["source_episode"].tolist() == shown_run.episodes["source_episode"].iloc[rows].tolist()
    assert table["frame"].tolist() == shown_run.control_steps[rows, table["inference"]].tolist()
    assert set(table["frame"]) == {0, 5, 10, 15}


@pytest.mark.slow
def test_a_memory_map_holds_the_stored_bits_and_its_index_leads_back(recorded_run: Run, tmp_path: Path) -> None:
    out = export_run(recorded_run.path, "sae", tmp_path / "sae", sites=["expert.03", "backbone.01"], view="tokens")
    index = pd.read_parquet(out / "expert" / "index.parquet")
    mapped = np.load(out / "expert" / f"{SITE}.npy", mmap_mode="r")
    assert isinstance(mapped, np.memmap)
    values, mask = recorded_run.tokens(SITE)
    assert mapped.shape == (mask.sum(), values.shape[2])
    assert not index.duplicated(["episode_id", "inference", "token"]).any()
    rows = index["episode_id"].map(rows_of(recorded_run)).to_numpy()
    np.testing.assert_array_equal(mapped, bits_of(recorded_run, SITE)[rows, index["token"]])
    as_torch = torch.from_numpy(np.array(mapped)).view(torch.bfloat16).float().numpy()
    np.testing.assert_array_equal(as_torch, values[rows, index["token"]])
    steps = np.diff(rows)
    assert (steps != 0).mean() > 0.5  # rows of one episode lie apart
    scale = json.loads((out / "scales.json").read_text(encoding="utf-8"))["sites"][str(SITE)]["scale"]
    norms = (as_torch.astype(np.float64) * scale) ** 2
    assert norms.sum(axis=1).mean() == pytest.approx(values.shape[2], rel=1e-9)


@pytest.mark.slow
def test_pooled_memory_maps_are_rounded_as_torch_does_and_share_one_order(
    recorded_run: Run, tmp_path: Path
) -> None:
    wide = export_run(recorded_run.path, "sae", tmp_path / "b")
    half = export_run(recorded_run.path, "sae", tmp_path / "h", dtype="float16", seed=1)
    orders = {
        folder: pd.read_parquet(folder / "expert" / "index.parquet")["episode_id"] for folder in (wide, half)
    }
    assert orders[wide].tolist() != orders[half].tolist()
    assert orders[wide].equals(pd.read_parquet(wide / "backbone" / "index.parquet")["episode_id"])
    column = torch.from_numpy(recorded_run.column(SITE))
    rows = {folder: order.map(rows_of(recorded_run)).to_numpy() for folder, order in orders.items()}
    bits = torch.from_numpy(np.load(wide / "expert" / f"{SITE}.npy")).view(torch.bfloat16)
    assert torch.equal(bits, column[rows[wide]].to(torch.bfloat16))
    stored = torch.from_numpy(np.load(half / "expert" / f"{SITE}.npy"))
    assert torch.equal(stored, column[rows[half]].to(torch.float16))


def test_every_file_of_a_folder_is_in_its_sums_and_none_is_a_picture(labelled_run: Path, tmp_path: Path) -> None:
    out = export_run(labelled_run, "sae", tmp_path / "sae")
    lines = [line.split("  ") for line in (out / "SHA256SUMS").read_text(encoding="utf-8").splitlines()]
    assert all(hashlib.sha256((out / name).read_bytes()).hexdigest() == digest for digest, name in lines)
    files = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert files == {name for _, name in lines} | {"SHA256SUMS"}
    assert {Path(name).suffix for name in files} <= {".npy", ".parquet", ".json", ""}


@pytest.mark.parametrize("style", ["parquet", "sae"])
def test_damage_stops_the_export_and_leaves_nothing(labelled_run: Path, tmp_path: Path, style: str) -> None:
    copy = Path(shutil.copytree(labelled_run, tmp_path / "run"))
    chunk = next(p for p in (copy / "data.zarr/expert/pooled/c/9").rglob("*") if p.is_file())
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(RunDamagedError):
        export_run(copy, style, tmp_path / "out" / "run")
    assert not list((tmp_path / "out").iterdir())


def test_a_value_beyond_float16_is_refused_by_site(little_runs: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"backbone\.00.*65504.*bfloat16"):
        export_run(little_runs / "run", "sae", tmp_path / "sae", view="tokens", dtype="float16")
    assert not list(tmp_path.iterdir())


def test_exporting_an_array_that_is_not_stored_lists_those_that_are(labelled_run: Path, tmp_path: Path) -> None:
    def export(style: str, **options: object) -> None:
        export_run(labelled_run, style, tmp_path / "out", **options)

    with pytest.raises(UnknownSiteError, match=r"no site 'decoder'; it has backbone\.00\.residual to"):
        export("parquet", sites=["decoder"])
    with pytest.raises(UnknownSiteError, match=r"view 'last'.*backbone: mean; expert: mean"):
        export("parquet", view="last")
    with pytest.raises(UnknownSiteError, match=r"tokens.*--tokens all"):
        export("sae", sites=["backbone"], view="tokens")
    with pytest.raises(UsageError, match=r"--sites or --view with --format h5.*parquet, sae"):
        export("h5", sites=["backbone"])
    with pytest.raises(UsageError, match="--dtype or --seed with --format parquet"):
        export("parquet", seed=3)
    with pytest.raises(UsageError, match="no sites are named"):
        export("sae", sites=[])
    assert not list(tmp_path.iterdir())


FIRST_SITE = Site("expert", 3, iteration=7)


@pytest.mark.slow
def test_safetensors_hold_the_numbers_and_true_bfloat16(recorded_run: Run, tmp_path: Path) -> None:
    out = export_run(recorded_run.path, "safetensors", tmp_path / "run.safetensors")
    with safe_open(out, "pt") as file:
        pooled, tokens = file.get_tensor("expert.pooled"), file.get_tensor("expert.tokens")
        assert "side_correct" in file.metadata()["episodes"]
    np.testing.assert_array_equal(pooled[:, 0, 7, 3, 0], recorded_run.column(FIRST_SITE))
    assert tokens.dtype == torch.bfloat16
    values, mask = recorded_run.tokens(FIRST_SITE)
    np.testing.assert_array_equal(tokens[:, 0, 7, 3].float().numpy()[mask], values[mask])


@pytest.mark.slow
@given(st.lists(st.integers(1, 5000), min_size=1, max_size=5), st.integers(1, 8), st.integers(64, 2**20))
def test_a_chunk_of_h5_is_a_part_of_one_episode_below_the_limit(shape: list[int], item: int, limit: int) -> None:
    chunk = _chunk_below((1, *shape), item, limit)
    assert item * math.prod(chunk) <= limit
    assert all(1 <= part <= extent for part, extent in zip(chunk, (1, *shape), strict=True))
    if item * math.prod(shape) <= limit:
        assert chunk == (1, *shape)


def test_h5_holds_the_numbers_and_the_episodes(recorded_run: Run, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    with h5py.File(export_run(recorded_run.path, "h5", tmp_path / "run.h5")) as file:
        np.testing.assert_array_equal(file["expert/pooled"][:, 0, 7, 3, 0], recorded_run.column(FIRST_SITE))
        assert file["episodes/category"].asstr()[:].tolist() == recorded_run.episodes["category"].tolist()
        assert file["expert/pooled"].fletcher32


@pytest.mark.slow
def test_parquet_holds_a_row_per_vector(recorded_run: Run, tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    table = pq.read_table(export_run(recorded_run.path, "parquet", tmp_path / "run.parquet")).to_pandas()
    vectors = table[(table["site"] == str(FIRST_SITE)) & (table["view"] == "mean")]
    np.testing.assert_array_equal(np.stack(vectors["vector"]), recorded_run.column(FIRST_SITE))


@pytest.mark.slow
def test_the_checksum_beside_the_file_is_that_of_the_file(recorded_run: Run, tmp_path: Path) -> None:
    out = export_run(recorded_run.path, "safetensors", tmp_path / "run.safetensors")
    digest, name = (tmp_path / "run.safetensors.sha256").read_text(encoding="utf-8").split()
    assert (digest, name) == (hashlib.sha256(out.read_bytes()).hexdigest(), out.name)


def test_damage_stops_the_export_and_leaves_no_file(recorded_run: Run, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(recorded_run.path, tmp_path / "run"))
    chunk = next(p for p in (copy / "data.zarr/backbone/pooled/c/3").rglob("*") if p.is_file())
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(RunDamagedError):
        export_run(copy, "safetensors", tmp_path / "out" / "run.safetensors")
    assert not list((tmp_path / "out").iterdir())


def test_unknown_formats_and_existing_files_are_refused(recorded_run: Run, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="parquet"):
        export_run(recorded_run.path, "csv", tmp_path / "run.csv")
    (tmp_path / "there").write_text("mine", encoding="utf-8")
    with pytest.raises(UsageError, match="exists"):
        export_run(recorded_run.path, "safetensors", tmp_path / "there")


def test_a_missing_library_is_named(recorded_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match="pyarrow"):
        export_run(recorded_run.path, "parquet", tmp_path / "run.parquet")


EPISODES = 2


@pytest.fixture(scope="module")
def copies(little_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Run]:
    """A run and its copy."""
    run = open_run(little_runs / "run")
    return run, copy_run(run.location, tmp_path_factory.mktemp("copy") / "run")


def table_of(run: Run) -> object:
    return json.loads(retention_table([run]).to_json().replace(str(run.location), "RUN"))


def test_every_number_of_a_table_is_that_of_the_run(copies: tuple[Run, Run]) -> None:
    run, copy = copies
    assert table_of(copy) == table_of(run)
    assert (copy.stamp, copy.settings_sha256, copy.label) == (run.stamp, run.settings_sha256, run.label)
    assert copy.episodes.equals(run.episodes)
    assert (copy.trajectory(0).tool == run.trajectory(0).tool).all() if run.has_trajectories else True


def test_an_export_refuses_by_name_the_parts_that_a_run_lacks(copies: tuple[Run, Run]) -> None:
    _, copy = copies
    site = copy.sites("backbone")[0]
    with pytest.raises(ActivationsLeftOutError, match=str(site)):
        copy.column(site)
    with pytest.raises(ActivationsLeftOutError, match="tokens of backbone"):
        copy.tokens(site)
    with pytest.raises(ActivationsLeftOutError, match="nothing to seal"):
        seal(copy.location)


def test_it_is_small_whole_and_says_what_it_is(copies: tuple[Run, Run]) -> None:
    run, copy = copies
    audit = verify_run(copy.location, deep=True)
    assert audit.ok
    assert audit.finished
    assert audit.left_out == ("backbone/pooled", "backbone/tokens", "expert/pooled", "expert/tokens")
    assert audit.strays == verify_run(run.location).left_out == ()
    assert not [file for file in copy.path.glob("data.zarr/*/*/c/**") if "trajectory" not in file.parts]
    assert not (copy.path / "columns.zarr").exists()
    assert not (copy.path / "frames").exists()


def test_nothing_can_be_added_to_it(copies: tuple[Run, Run], small_suite: Suite) -> None:
    plan = little_plan(small_suite.select(["color"]))
    with pytest.raises(ActivationsLeftOutError, match="nothing can be added"):
        RunWriter(copies[1].location, plan, little_settings())


def test_damage_is_still_damage(copies: tuple[Run, Run], tmp_path: Path) -> None:
    copy = Path(shutil.copytree(copies[1].path, tmp_path / "copy"))
    record = copy / "left-out.json"
    content = record.read_text(encoding="utf-8")
    record.write_text(content.replace("backbone/pooled", "backbone/poolex"), encoding="utf-8")
    with pytest.raises(RunDamagedError, match="left-out"):
        open_run(copy)
    record.unlink()
    with pytest.raises(RunDamagedError, match="is missing"):
        open_run(copy)
    record.write_text(content, encoding="utf-8")
    trajectories = [file for file in copy.rglob("data.zarr/trajectory/c/*/*/*") if file.is_file()]
    trajectories[0].unlink()
    with pytest.raises(RunDamagedError, match="trajectory"):
        open_run(copy)


def test_a_place_that_is_not_empty_is_refused(copies: tuple[Run, Run]) -> None:
    run, copy = copies
    with pytest.raises(UsageError, match="not empty"):
        copy_run(run.location, copy.location)
