import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zarr
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import RunDamagedError
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs import Run, open_run, seal
from probe_kit.runs.run import NotSealedWarning
from tests.runs.contents import hashes

SITES = (Site("backbone", 2), Site("expert", 3, iteration=7))


@pytest.fixture
def copy(recorded_run: Run, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded_run.path, tmp_path / "run"))


def test_columns_hold_exactly_the_numbers_of_the_rows(recorded_run: Run, copy: Path) -> None:
    assert recorded_run.sealed
    shutil.rmtree(copy / "columns.zarr")
    unsealed = open_run(copy)
    for stream in recorded_run.streams:
        for site in recorded_run.sites(stream):
            for view in recorded_run.views(stream):
                with pytest.warns(NotSealedWarning):
                    rows = unsealed.column(site, view)
                np.testing.assert_array_equal(recorded_run.column(site, view), rows)


def test_sealing_again_gives_the_same_bytes_and_a_second_time_does_nothing(copy: Path) -> None:
    before = hashes(copy)
    assert not seal(copy)
    shutil.rmtree(copy / "columns.zarr")
    assert seal(copy)
    assert hashes(copy) == before
    shutil.rmtree(copy / "columns.zarr")
    answer = CliRunner().invoke(app, ["run", "verify", str(copy), "--seal"])
    assert (answer.exit_code, "48 of 48 episodes, sealed" in answer.stdout) == (0, True), answer.output
    assert hashes(copy) == before


@pytest.mark.slow
@pytest.mark.parametrize("finished", [True, False])
def test_what_a_killed_seal_left_is_cleared_by_the_next_one(copy: Path, finished: bool) -> None:
    before = hashes(copy)
    left = copy / "columns.zarr" / "of-fewer"
    left.mkdir()
    (left / "zarr.json").write_bytes(b"{}")
    if not finished:
        (columns,) = (path for path in left.parent.iterdir() if path != left)
        (columns / "zarr.json").write_bytes(b"{}")
        shutil.rmtree(copy / "sealed")
    seal(copy)
    assert hashes(copy) == before


@pytest.mark.slow
def test_a_slab_smaller_than_the_run_changes_nothing(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = hashes(copy)
    shutil.rmtree(copy / "columns.zarr")
    monkeypatch.setattr("probe_kit.runs.verify.SLAB_BYTES", 3 * 48 * 96 * 4)
    seal(copy)
    assert hashes(copy) == before


@pytest.mark.filterwarnings("ignore:.*is not sealed")
def test_columns_of_other_commits_are_not_used_until_sealed_again(copy: Path) -> None:
    (copy / "commits/00000005.json").unlink()
    with pytest.raises(RunDamagedError, match=r"commits/00000005\.json is missing.*delete sealed"):
        seal(copy)
    shutil.rmtree(copy / "sealed")
    run = open_run(copy, allow_partial=True)
    with pytest.warns(NotSealedWarning, match=r"probe-kit run verify .* --seal"):
        assert run.column(SITES[0]).shape == (47, 96)
    assert seal(copy)
    again = open_run(copy, allow_partial=True)
    assert again.sealed
    np.testing.assert_array_equal(again.column(SITES[0]), run.column(SITES[0]))


def test_a_flipped_bit_in_a_column_is_an_error_that_says_how_to_rebuild(copy: Path) -> None:
    chunk = next(path for path in copy.glob("columns.zarr/*/backbone/pooled/c/0/0/2/**/*") if path.is_file())
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(RunDamagedError, match=r"run verify .* --seal"):
        open_run(copy).column(SITES[0])


def test_role_codes_name_every_token_position(recorded_run: Run) -> None:
    role = zarr.open_array(next(recorded_run.path.glob("columns.zarr/*/backbone/role")), mode="r")
    names = role.attrs["roles"]
    _, mask = recorded_run.tokens(SITES[0], "language")
    np.testing.assert_array_equal(np.asarray(role[0]) == names.index("language"), mask)
    assert names[0] == "padding"


def test_the_labelled_dataset_is_the_same_with_and_without_columns(recorded_run: Run, copy: Path) -> None:
    shutil.rmtree(copy / "columns.zarr")
    assert recorded_run.xarray().identical(open_run(copy).xarray())


def test_token_blocks_put_together_are_the_tokens(recorded_run: Run) -> None:
    for site in SITES:
        values, mask = recorded_run.tokens(site)
        for block in recorded_run.iter_token_blocks(site):
            stop = block.start + block.mask.shape[1]
            np.testing.assert_array_equal(block.values, values[:, block.start : stop])
            np.testing.assert_array_equal(block.mask, mask[:, block.start : stop])


def test_the_gram_matrix_equals_the_one_computed_in_float64(recorded_run: Run) -> None:
    values, mask = recorded_run.tokens(SITES[0], "language")
    flat = values.astype(np.float64).reshape(48, -1)
    expected = flat @ flat.T / np.sqrt(np.outer(mask.sum(1), mask.sum(1)))
    np.testing.assert_allclose(recorded_run.gram(SITES[0], "language"), expected, rtol=1e-5)


def test_reading_a_run_needs_neither_torch_nor_simulator(recorded_run: Run) -> None:
    code = f"""
import sys
from probe_kit.runs import open_run
from probe_kit.hooks.contract.sites import Site
run = open_run({str(recorded_run.path)!r})
run.column(Site("backbone", 1)), run.tokens(Site("backbone", 1), "language"), run.gram(Site("backbone", 1))
print([name for name in ("torch", "pybullet", "lerobot", "transformers") if name in sys.modules])
"""
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True)
    assert loaded.stdout.strip() == "[]"
