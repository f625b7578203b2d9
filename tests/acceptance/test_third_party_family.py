"""A model family of a third party, from `probe-kit new-adapter` to its retention."""

import importlib
import runpy
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import probe_kit as pk
from tests.acceptance.product import environment, probe_kit

PLAYED = ("--categories", "color", "--items", "12", "--max-steps", "2", "--env-workers", "0")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The written package on the path, with the two files beside it that pip writes from its `pyproject.toml`."""
    folder = tmp_path_factory.mktemp("third") / "my-vla"
    probe_kit("new-adapter", "my-vla", "--out", folder)
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    entries = project["entry-points"]["probe_kit.policies"]
    information = folder / "my_vla-0.1.0.dist-info"
    information.mkdir()
    named = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (information / "METADATA").write_text(named, encoding="utf-8")
    lines = ["[probe_kit.policies]", *(f"{name} = {target}" for name, target in entries.items())]
    (information / "entry_points.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    yield folder
    sys.path.remove(str(folder))
    importlib.invalidate_caches()
    for name in [name for name in sys.modules if name.partition(".")[0] == "my_vla"]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def checkpoint(installed: Path) -> Path:
    """Invented weights, written as the README of the package says."""
    assert "python -m my_vla.checkpoint checkpoint" in (installed / "README.md").read_text(encoding="utf-8")
    arguments = sys.argv
    sys.argv = ["checkpoint", str(installed / "checkpoint")]
    try:
        runpy.run_module("my_vla.checkpoint", run_name="__main__")
    finally:
        sys.argv = arguments
    return installed / "checkpoint"


@pytest.fixture(scope="module")
def family_run(checkpoint: Path) -> Path:
    folder = checkpoint.parent / "run"
    probe_kit("extract", "--model", "my-vla", "--checkpoint", checkpoint, *PLAYED, "--out", folder)
    return folder


def test_an_installed_family_is_listed_and_described(installed: Path) -> None:
    assert installed.is_dir()
    assert "my-vla" in {row["model"] for row in probe_kit("models", "--json").json()}
    assert "my-vla" in probe_kit("models", "my-vla").text
    assert "already" in probe_kit("new-adapter", "my-vla", "--out", installed.parent / "twice", code=2).text


def test_a_run_of_it_has_the_streams_that_it_declares(family_run: Path) -> None:
    run = pk.open_run(family_run)
    assert run.model == "my-vla"
    assert len(run.episodes) == 24
    parts = {stream.part for stream in run.streams.values()}
    assert parts == {"backbone", "action"}
    for name, stream in run.streams.items():
        iteration = None if stream.iterations is None else 0
        column = run.column(pk.Site(name, stream.layers - 1, iteration=iteration), "mean")
        assert column.shape == (24, stream.width)
        assert np.isfinite(column).all()


def test_its_run_is_probed_and_has_a_row_of_retention_per_category(family_run: Path) -> None:
    probe_kit("train", family_run, "--permutations", "5", "--controls", "position")
    table = probe_kit("retention", family_run, "--format", "json").json()
    assert "my-vla" in str(table)
    assert "color" in str(table)
    printed = pk.retention_table([pk.open_run(family_run)]).to_markdown()
    assert "color" in printed.casefold()


@pytest.mark.slow
def test_the_contract_is_kept_as_it_is_written(checkpoint: Path) -> None:
    checked = probe_kit("check-adapter", "my-vla", "--checkpoint", checkpoint)
    assert checked.text.count("passed") > 10


@pytest.mark.slow
def test_the_written_tests_run_the_same_contract(installed: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests"],
        cwd=installed,
        env=environment(PYTHONPATH=str(installed)),
        capture_output=True,
        encoding="utf-8",
        check=False,
        timeout=900,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(done.stdout.strip().rpartition("\n")[2].split()[0]) > 20, done.stdout


def test_weights_that_the_network_does_not_have_are_refused_by_name(checkpoint: Path) -> None:
    import safetensors.numpy

    (file,) = checkpoint.glob("*.safetensors")
    tensors = safetensors.numpy.load_file(file)
    broken = checkpoint.parent / "broken"
    broken.mkdir()
    for other in checkpoint.iterdir():
        if other != file:
            (broken / other.name).write_bytes(other.read_bytes())
    safetensors.numpy.save_file({**tensors, "surplus": np.zeros(3, np.float32)}, broken / file.name)
    refused = probe_kit(
        "extract", "--model", "my-vla", "--checkpoint", broken, *PLAYED, "--out", broken / "run", code=3
    )
    assert "surplus" in refused.text
