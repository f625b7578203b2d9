"""Other tools read `items/` as it is."""

from collections import defaultdict
from typing import Any

import pytest

from probe_kit.suite import Suite


def types_of(value: Any, path: str, found: dict[str, set[str]]) -> None:
    """Collects the type of every key, at any depth."""
    if isinstance(value, dict):
        for key, inner in value.items():
            types_of(inner, f"{path}.{key}", found)
    elif isinstance(value, list | tuple):
        for inner in value:
            types_of(inner, f"{path}[]", found)
    else:
        found[path].add(type(value).__name__)


def test_every_key_has_one_type_in_all_categories(embedded: Suite) -> None:
    """Arrow infers one type per key; a key that is a number here and a text there cannot be read."""
    found: dict[str, set[str]] = defaultdict(set)
    for item in embedded.items:
        types_of(item.to_json(), "", found)
    assert {path: types for path, types in found.items() if len(types) > 1} == {}


def test_the_imagefolder_reader_finds_both_pictures(small_suite: Suite) -> None:
    datasets = pytest.importorskip("datasets", reason="the optional package `datasets` is not installed")
    loaded = datasets.load_dataset("imagefolder", data_dir=str(small_suite.folder / "items"), split="train")
    assert len(loaded) == len(small_suite.items)
    assert loaded[0]["left"].size == loaded[0]["right"].size == (256, 256)
    assert loaded[0]["instruction"] == small_suite.items[0].instruction
