import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from probe_kit.errors import MissingExtraError, RunDamagedError, UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs import Run, export_run

SITE = Site("expert", 3, iteration=7)


def test_safetensors_hold_the_numbers_and_true_bfloat16(recorded_run: Run, tmp_path: Path) -> None:
    out = export_run(recorded_run.path, "safetensors", tmp_path / "run.safetensors")
    with safe_open(out, "pt") as file:
        pooled, tokens = file.get_tensor("expert.pooled"), file.get_tensor("expert.tokens")
        assert "side_correct" in file.metadata()["episodes"]
    np.testing.assert_array_equal(pooled[:, 0, 7, 3, 0], recorded_run.column(SITE))
    assert tokens.dtype == torch.bfloat16
    values, mask = recorded_run.tokens(SITE)
    np.testing.assert_array_equal(tokens[:, 0, 7, 3].float().numpy()[mask], values[mask])


def test_h5_holds_the_numbers_and_the_episodes(recorded_run: Run, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    with h5py.File(export_run(recorded_run.path, "h5", tmp_path / "run.h5")) as file:
        np.testing.assert_array_equal(file["expert/pooled"][:, 0, 7, 3, 0], recorded_run.column(SITE))
        assert file["episodes/category"].asstr()[:].tolist() == recorded_run.episodes["category"].tolist()
        assert file["expert/pooled"].fletcher32


@pytest.mark.slow
def test_parquet_holds_a_row_per_vector(recorded_run: Run, tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    table = pq.read_table(export_run(recorded_run.path, "parquet", tmp_path / "run.parquet")).to_pandas()
    chosen = table[(table["site"] == str(SITE)) & (table["view"] == "mean")]
    np.testing.assert_array_equal(np.stack(chosen["vector"]), recorded_run.column(SITE))


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
