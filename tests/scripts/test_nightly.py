"""The slow tests that run every night are all of them."""

import re
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]


def nightly() -> dict[str, Any]:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "nightly.yml").read_text(encoding="utf-8"))
    job: dict[str, Any] = workflow["jobs"]["slow"]
    return job


def test_every_folder_of_tests_is_in_one_part_of_the_night() -> None:
    parts = nightly()["strategy"]["matrix"]["part"]
    paths = [path for part in parts for path in part.split() if not path.startswith("--ignore=")]
    assert sorted(set(paths)) == sorted(paths), "no test runs twice"
    folders = {path.relative_to(ROOT / "tests").parts[0] for path in (ROOT / "tests").glob("*/**/test_*.py")}
    assert {path.split("/")[1] for path in paths} == folders | {"test_*.py"}
    assert "tests/hooks --ignore=tests/hooks/families" in parts, "families are a part of their own"


def test_a_part_that_fails_does_not_stop_the_others() -> None:
    assert nightly()["strategy"]["fail-fast"] is False


def test_every_part_plays_its_slow_tests_on_all_cores_and_none_is_skipped_for_want_of_a_browser() -> None:
    commands = [step["run"].partition("  #")[0].strip() for step in nightly()["steps"] if "run" in step]
    assert commands == [
        "chromium --version",
        "./with-uv pytest -m slow -n auto --dist loadfile --durations=20 ${{ matrix.part }}",
    ]


def test_every_night_draws_other_accidents() -> None:
    assert nightly()["env"] == {"PROBE_KIT_NIGHT": "${{ github.run_number }}"}


def test_the_page_about_tests_lists_every_part_with_its_time() -> None:
    """A row per part: its paths, its number of tests, and minutes of one core."""
    page = (ROOT / "tests" / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([^`]+)` \| ([\d,]+) \| ([^|]+) \|$", page, re.MULTILINE)
    assert [part for part, _, _ in rows] == nightly()["strategy"]["matrix"]["part"]
    assert all(re.search(r"\d", minutes) or "not measured" in minutes for _, _, minutes in rows)
