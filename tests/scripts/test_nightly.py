"""The slow tests that run every night are all of them."""

from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]


def test_every_folder_of_tests_is_in_one_part_of_the_night() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "nightly.yml").read_text(encoding="utf-8"))
    parts = workflow["jobs"]["slow"]["strategy"]["matrix"]["part"]
    paths = [path for part in parts for path in part.split() if not path.startswith("--ignore=")]
    assert sorted(set(paths)) == sorted(paths), "no test runs twice"
    folders = {path.relative_to(ROOT / "tests").parts[0] for path in (ROOT / "tests").glob("*/**/test_*.py")}
    assert {path.split("/")[1] for path in paths} == folders | {"test_*.py"}
    assert "tests/hooks --ignore=tests/hooks/families" in parts, "families are a part of their own"


def test_a_part_that_fails_does_not_stop_the_others() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "nightly.yml").read_text(encoding="utf-8"))
    assert workflow["jobs"]["slow"]["strategy"]["fail-fast"] is False
    commands = [step["run"] for step in workflow["jobs"]["slow"]["steps"] if "run" in step]
    assert commands == ["./with-uv pytest -m slow --durations=20 ${{ matrix.part }}"]
