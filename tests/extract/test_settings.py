"""What a run is called, and which questions its settings ask for."""

from pathlib import Path

import pytest

from probe_kit.extract import ExtractSettings
from probe_kit.extract.prepared import check_run
from probe_kit.extract.settings import run_label
from probe_kit.hooks import Edit, Site
from probe_kit.suite import load_suite

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
    assert plain.identity() != edited.identity()


@pytest.mark.slow
def test_only_what_is_asked_is_drawn_of_the_embedded_suite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path))
    suite = check_run(ExtractSettings("expert", categories=("color",), items=2))
    assert len(suite.items) == 2
    (drawn,) = (tmp_path / "suites").iterdir()
    assert {item.category for item in load_suite(drawn).items} == {"color"}


def test_a_policy_on_a_gpu_chooses_its_batch_unless_one_is_given() -> None:
    def chosen(model: str, **given: object) -> tuple[int, bool]:
        settings = ExtractSettings(model, **given)  # type: ignore[arg-type]
        return settings.batch, settings.calibrate

    assert chosen("pi0", device="cuda") == (1, True)
    assert chosen("pi0", device="cuda:1", batch=1) == (1, False)
    assert chosen("pi0", device="cuda", batch=8) == (8, False)
    assert chosen("pi0", device="cuda", env_workers=4) == (1, False)
    assert chosen("pi0") == chosen("expert", device="cuda") == (1, False)
    assert chosen("pi0", batch="auto") == (1, True)
