"""Benchmarks are run by hand, long after the measured code has changed: they import what exists, and run."""

import ast
import importlib
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"
SMALLEST: dict[str, list[str]] = {
    "capture": ["--families", "qwen3-vl", "--repeats", "1", "--host"],
    "cost_model": [],
    "diagnose_organisms": ["OUT", "--draws", "1", "--frames", "6", "--organisms", "deaf"],
    "drift_null": ["--draws", "1"],
    "env": ["speed", "--episodes", "1"],
    "exchange": ["--observations", "2"],
    "extract": ["--episodes", "4", "--width", "16", "--loop", "2", "--repeats", "1"],
    "full_run": ["OUT", "--episodes", "264", "--permutations", "1"],
    "integrity": ["--episodes", "8", "--width", "16", "--repeats", "1", "--gigabytes", "0.01"],
    "intervention_cost": ["--pairs", "2"],
    "intervention_null": ["OUT", "--networks", "1", "--inside", "1", "--items", "6", "--categories", "color"],
    "joint_probes": ["--episodes", "20", "--tokens", "4", "--width", "16"],
    "knockout_organisms": ["OUT", "--draws", "1", "--organisms", "nothing"],
    "label_cost": ["--permutations", "2"],
    "label_coverage": ["--draws", "2", "--only", "12 white"],
    "label_null": ["--labels", "1", "--tasks", "binary", "--jobs", "1"],
    "memory": ["--episodes", "4", "--items", "2", "--lines", "2"],
    "on_gpu": ["--device", "cpu", "--only", "probes"],
    "pooled_probes": ["--episodes", "60", "--width", "16", "--permutations", "2"],
    "power_trained": ["--items", "12", "--accuracies", "0.9", "--draws", "2"],
    "probe_null": ["--draws", "2"],
    "probes": ["--sizes", "60", "--permutations", "2", "--tokens", "4"],
    "reports": ["OUT", "--episodes", "264", "--permutations", "1"],
    "retention_coverage": ["--draws", "12", "--only", "6 groups, silent", "--workers", "1"],
    "score_coverage": ["--draws", "2"],
    "serve": ["--requests", "1", "--episodes", "4"],
    "suite_random_features": ["--items", "12", "--width", "8", "--categories", "color"],
    "throughput": ["--subjects", "tiny", "--batches", "1,2", "--repeats", "1"],
    "units": ["--worlds", "1"],
    "verdict_coverage": ["--draws", "4", "--only", "absent"],
    "waiting": ["--subjects", "tiny", "--items", "2"],
}
"""Arguments with which each ends soon; OUT is a folder that it makes. The figures mean nothing."""
MODULES = {"capture_subjects", "coverage_worlds", "kept_draws", "tests_of_checkout"}
"""Parts of others."""
ELSEWHERE = {
    "intervention_acceptance": "plays six policies for an hour",
    "null_worlds": "draws for minutes in its smallest form",
    "study_gpus": "needs Ray",
    "viewer": "needs a browser",
}


def _imported() -> list[tuple[str, str, str]]:
    """Return file, module and name of everything that benchmarks and scripts import from probe_kit."""
    return [
        (file.name, node.module, alias.name)
        for file in sorted([*FOLDER.glob("*.py"), *(FOLDER.parent / "scripts").rglob("*.py")])
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("probe_kit")
        for alias in node.names
    ]


def test_benchmarks_and_scripts_import_what_the_package_has() -> None:
    missing = [
        f"{file}: {module}.{name}"
        for file, module, name in _imported()
        if not hasattr(importlib.import_module(module), name) and find_spec(f"{module}.{name}") is None
    ]
    assert not missing


def test_every_benchmark_is_run_by_a_test_or_says_why_not() -> None:
    assert {file.stem for file in FOLDER.glob("*.py")} == SMALLEST.keys() | MODULES | ELSEWHERE.keys()


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALLEST)
def test_a_benchmark_runs_in_its_smallest_form(name: str, tmp_path: Path) -> None:
    arguments = [str(tmp_path / "out") if argument == "OUT" else argument for argument in SMALLEST[name]]
    command = [sys.executable, str(FOLDER / f"{name}.py"), *arguments]
    completed = subprocess.run(command, cwd=tmp_path, capture_output=True, encoding="utf-8", check=False)
    assert completed.returncode == 0, completed.stdout[-1000:] + completed.stderr[-3000:]
    assert completed.stdout.strip()
