"""Results that are stored beside arrays in memory, where there is no run."""

from pathlib import Path

import pytest

from probe_kit.runs import root
from probe_kit.runs.layout import INTERVENTIONS
from probe_kit.runs.results import PARTIAL, bundle_keys, read_bundles, write_bundle
from probe_kit.runs.store import locate

KEY = "0123456789ab"


def test_results_beside_arrays_are_read_without_a_search_for_runs_around_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search lists the folder above, which may hold thousands of others."""
    location = locate(tmp_path / "arrays")
    write_bundle(location, INTERVENTIONS, KEY, {"settings": {"kind": "mine"}})

    def search(address: str) -> str:
        raise AssertionError(f"looked for runs near {address}")

    monkeypatch.setattr(root, "what_to_open", search)
    assert read_bundles(location, INTERVENTIONS)[KEY].head["settings"] == {"kind": "mine"}


def test_a_complete_result_counts_beside_what_a_killed_process_left_of_it(tmp_path: Path) -> None:
    """Else a table would lose a category, and no message would name it."""
    location = locate(tmp_path / "arrays")
    unfinished = "ba9876543210"
    write_bundle(location, INTERVENTIONS, KEY, {"settings": {"kind": "mine"}}, {"effects.json": b"{}"})
    for key in (KEY, unfinished):
        location.write(f"{INTERVENTIONS}/.{key}{PARTIAL}/piece.npz", b"half of a piece")
    location.write(f"{INTERVENTIONS}/{unfinished}/effects.json", b"{}")
    assert bundle_keys(location, INTERVENTIONS) == [KEY]
    assert read_bundles(location, INTERVENTIONS)[KEY].read("effects.json") == b"{}"
