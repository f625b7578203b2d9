"""A suite large enough for statistics, and copies of the small one to damage."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from probe_kit.suite import Suite, build_suite, load_suite
from tests.support.made_once import made_once


@pytest.fixture(scope="session")
def embedded(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    """All embedded categories with 20 items each."""
    return load_suite(made_once(tmp_path_factory, "embedded", lambda at: build_suite(at, items_per_category=20)))


@pytest.fixture
def copied(small_suite: Suite, tmp_path: Path) -> Path:
    """A folder with a copy of the small suite."""
    return Path(shutil.copytree(small_suite.folder, tmp_path / "copied"))


@pytest.fixture
def edit_records(copied: Path) -> Callable[[Callable[[list[dict[str, Any]]], None]], Path]:
    """Changes the records of the copied suite, and nothing else, and gives its folder."""

    def edit(change: Callable[[list[dict[str, Any]]], None]) -> Path:
        path = copied / "items" / "metadata.jsonl"
        records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        change(records)
        path.write_text("".join(json.dumps(record) + "\n" for record in records), encoding="utf-8")
        return copied

    return edit
