"""`probe-kit new-adapter`: what it writes is a family that keeps the contract and can be extracted from."""

import subprocess
import sys
from pathlib import Path

import pytest

from probe_kit.errors import UsageError
from probe_kit.hooks.new_adapter import write_adapter
from probe_kit.runs import open_run
from probe_kit.suite import Suite, build_suite
from probe_kit.train import load_results

ENTRY = "[probe_kit.policies]\nmy-vla = my_vla:FAMILY\n"


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package, with the two files beside it that pip would write."""
    write_adapter("my-vla", tmp_path / "mine")
    info = tmp_path / "mine" / "my_vla-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-vla\nVersion: 0.1\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(ENTRY, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "mine"))
    return tmp_path / "mine"


def ran(folder: Path, *arguments: str) -> str:
    completed = subprocess.run(
        [sys.executable, "-m", *arguments],
        cwd=folder,
        capture_output=True,
        encoding="utf-8",
        check=False,
        timeout=300,
    )
    assert completed.returncode == 0, completed.stdout + completed.stderr
    return completed.stdout


@pytest.mark.slow
def test_it_keeps_the_contract_as_it_is(installed: Path) -> None:
    assert ENTRY.splitlines()[1].replace("my_vla:FAMILY", '"my_vla:FAMILY"') in (
        installed / "pyproject.toml"
    ).read_text(encoding="utf-8")
    tested = ran(installed, "pytest", "-q", "-p", "no:cacheprovider", "tests")
    assert "failed" not in tested
    assert int(tested.rpartition("\n")[0].rpartition("\n")[2].split()[0]) > 20, tested


@pytest.mark.slow
def test_a_run_is_made_with_it_as_its_readme_says(installed: Path, small_suite: Suite) -> None:
    ran(installed, "my_vla.checkpoint", "checkpoint")
    suite = ("--suite", str(small_suite.folder), "--items", "2")
    arguments = ("--model", "my-vla", "--checkpoint", "checkpoint", *suite)
    run = ran(installed, "probe_kit", "extract", *arguments, "--max-steps", "4", "--out", "run")
    assert run.strip().endswith("run")


@pytest.mark.slow
def test_the_written_family_goes_all_the_way_without_naming_a_folder_twice(
    installed: Path, tmp_path: Path
) -> None:
    """Its file calls its weights random, which no option requested. The suite cannot be drawn again."""
    ran(installed, "my_vla.checkpoint", "checkpoint")
    build_suite(installed / "suite", ["color"], 12, seed=5)
    played = ("--categories", "color", "--max-steps", "2", "--env-workers", "0", "--out", str(tmp_path / "run"))
    options = ("--model", "my-vla", "--checkpoint", "checkpoint", "--suite", "suite")
    ran(installed, "probe_kit", "extract", *options, *played)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    ran(elsewhere, "probe_kit", "train", "../run", "--permutations", "20")
    assert load_results(open_run(tmp_path / "run")).controls.comparisons
    ran(elsewhere, "probe_kit", "intervene", "../run", "--items", "2")
    table = " ".join(ran(elsewhere, "probe_kit", "retention", "../run", "--details", "all").split())
    assert "Whether the answer is used in the first chunk is undecided" in table, "two items are one group"
    ran(elsewhere, "probe_kit", "view", "../run", "--export", "page")
    assert (elsewhere / "page" / "index.html").is_file()


@pytest.mark.parametrize("name", ["My-VLA", "1vla", "my_vla", "-", "class", ""])
def test_an_impossible_name_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot name a family"):
        write_adapter(name, tmp_path / "mine")


@pytest.mark.parametrize(
    ("name", "origin"),
    [
        ("json", "Python's standard library"),
        ("my-local-module", "my_local_module.py"),
        *(
            pytest.param(name, origin, marks=pytest.mark.slow)
            for name, origin in {
                "sys": "Python's standard library", "numpy": "numpy", "torch": "torch", "probe-kit": "probe_kit",
                "safetensors": "safetensors", "yaml": "PyYAML",
            }.items()
        ),
    ],
)  # fmt: skip
def test_the_name_of_a_module_is_refused_because_the_package_would_hide_it(
    name: str, origin: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_local_module.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UsageError, match=f"would hide the module .*{origin}.*give yours another name"):
        write_adapter(name, tmp_path / "mine")
    assert not (tmp_path / "mine").exists()


@pytest.mark.slow
def test_a_name_that_is_taken_and_a_folder_that_is_full_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="already"):
        write_adapter("pi0", tmp_path / "mine")
    (tmp_path / "note").touch()
    with pytest.raises(UsageError, match="holds something"):
        write_adapter("my-vla", tmp_path)
