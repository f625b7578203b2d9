"""What a run is called."""

from pathlib import Path

import pytest

from probe_kit.extract import ExtractSettings
from probe_kit.extract.settings import run_label
from probe_kit.hooks import Edit, Site

ZERO = Edit("zero", (Site("backbone", 1),))


@pytest.mark.parametrize(
    ("settings", "label"),
    [
        (ExtractSettings("pi0"), "pi0"),
        (ExtractSettings("pi0", checkpoint=str(Path("runs") / "mine")), "pi0 · mine"),
        (ExtractSettings("openvla", options={"centre_crop": True}), "openvla · centre_crop=True"),
        (ExtractSettings("pi0", random_weights=True, weights_seed=2), "pi0 · twin 2"),
        (ExtractSettings("pi0", label="after fine-tuning"), "after fine-tuning"),
    ],
)
def test_what_sets_a_run_apart_is_in_its_label(settings: ExtractSettings, label: str) -> None:
    assert run_label(settings) == label


def test_an_edited_run_is_called_so_and_is_another_run() -> None:
    plain, edited = ExtractSettings("pi0"), ExtractSettings("pi0", edits=(ZERO,))
    assert run_label(edited).startswith("pi0 · edited ")
    assert plain.choices() != edited.choices()
