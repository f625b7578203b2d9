"""Chosen vectors come out as the libraries read them, bit for bit as they are stored, and lead back to frames."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from numpy.typing import NDArray

from probe_kit.errors import RunDamagedError, UnknownSiteError, UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs import Run, export_run, open_run

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
    found = np.load(out / "expert" / f"{SITE}.npy", mmap_mode="r")
    assert isinstance(found, np.memmap)
    values, mask = recorded_run.tokens(SITE)
    assert found.shape == (mask.sum(), values.shape[2])
    assert not index.duplicated(["episode_id", "inference", "token"]).any()
    rows = index["episode_id"].map(rows_of(recorded_run)).to_numpy()
    np.testing.assert_array_equal(found, bits_of(recorded_run, SITE)[rows, index["token"]])
    as_torch = torch.from_numpy(np.array(found)).view(torch.bfloat16).float().numpy()
    np.testing.assert_array_equal(as_torch, values[rows, index["token"]])
    steps = np.diff(rows)
    assert (steps != 0).mean() > 0.5  # rows of one episode lie apart
    scale = json.loads((out / "scales.json").read_text(encoding="utf-8"))["sites"][str(SITE)]["scale"]
    norms = (as_torch.astype(np.float64) * scale) ** 2
    assert norms.sum(axis=1).mean() == pytest.approx(values.shape[2], rel=1e-9)


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
    rows = {folder: own.map(rows_of(recorded_run)).to_numpy() for folder, own in orders.items()}
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


def test_what_is_not_stored_is_refused_with_what_is(labelled_run: Path, tmp_path: Path) -> None:
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
