"""The states of settings: each has a type, is made in one place, and lacks what a later state decides."""

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

from probe_kit.env import SceneSpec
from probe_kit.extract import AskSettings, ExtractSettings, prepare
from probe_kit.extract.extraction import open_checked
from probe_kit.extract.parts import ActMachine, AskCapture, AskMachine, Capture
from probe_kit.extract.states import Decided, Fitted
from probe_kit.suite import Suite
from tests.support.parsed import PACKAGE, package_nodes

PLACES = {"Decided": {"open_checked"}, "Fitted": {"count_calls"}, "LoadedModel": {"fit"}}
BRIEF = SceneSpec(max_steps=4)


@cache
def functions_by_call() -> dict[str, set[str]]:
    """Return the functions of the package that call a name, by the name."""
    functions: dict[str, set[str]] = defaultdict(set)
    for _, function in package_nodes(ast.FunctionDef):
        for call in ast.walk(function):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name):
                functions[call.func.id].add(function.name)
    return functions


@pytest.mark.parametrize("name", PLACES)
def test_a_state_is_made_in_one_place(name: str) -> None:
    assert functions_by_call()[name] == PLACES[name]


def test_before_the_model_is_there_no_number_of_captured_inferences_exists(small_suite: Suite) -> None:
    settings = ExtractSettings("pi0-tiny", suite=small_suite.folder, scene=BRIEF, captured_calls="all", items=2)
    decided, _ = open_checked(settings)
    assert type(decided) is Decided
    for holder in (settings, decided, decided.settings.capture, Capture, AskCapture, ActMachine, AskMachine):
        assert not hasattr(holder, "calls")
        assert not hasattr(holder, "observations")
    extraction = prepare(settings.changed(execute=2))
    assert type(extraction.fitted) is Fitted
    assert extraction.fitted.calls == extraction.settings.capture.captured_calls == 2
    assert extraction.loaded is not None
    assert extraction.loaded.observations == 1
    assert extraction.identity()["captured_calls"] == 2


def test_a_request_stays_as_it_was_typed(small_suite: Suite) -> None:
    settings = ExtractSettings("pi0-tiny", suite=small_suite.folder, scene=BRIEF, captured_calls="all", items=2)
    typed = settings.config()
    prepare(settings)
    assert settings.config() == typed


def test_workers_measure_their_own_batch_and_the_plan_has_none(small_suite: Suite) -> None:
    settings = ExtractSettings("pi0-tiny", suite=small_suite.folder, scene=BRIEF, items=2, workers=1, batch="auto")
    extraction = prepare(settings)
    assert extraction.loaded is None
    assert extraction.settings.machine.batch == "auto"
    assert extraction.fitted.calls == 1


def test_a_question_is_captured_once(small_suite: Suite) -> None:
    extraction = prepare(AskSettings("vlm-tiny", suite=small_suite.folder, items=2, tokens="pooled", prompt="p2"))
    assert extraction.fitted.calls == 1


WRONG = """
from probe_kit.extract import ExtractSettings
from probe_kit.extract.rollout.controllers import Controller
from probe_kit.extract.rollout.tasks import Act
from probe_kit.extract.rollout.worker import certificate_of
from probe_kit.extract.states import Decided, Fitted

def count(decided: Decided[ExtractSettings]) -> int:
    return decided.calls

def certify(controller: Controller, decided: Decided[ExtractSettings], fitted: Fitted[ExtractSettings]) -> None:
    certificate_of(controller, fitted)
    certificate_of(controller, decided)
    Act().declared_inputs(decided)
    Act().declared_inputs(decided.settings)
"""
ERRORS = {9: '"Decided[ExtractSettings]" has no attribute "calls"', 13: "Argument 2", 15: "Argument 1"}


@pytest.mark.slow
def test_mypy_refuses_settings_of_another_state(tmp_path: Path) -> None:
    api = pytest.importorskip("mypy.api")
    file = tmp_path / "wrong_states.py"
    file.write_text(WRONG, encoding="utf-8")
    root = PACKAGE.parent
    options = ["--config-file", str(root / "pyproject.toml"), "--cache-dir", str(tmp_path / "cache")]
    report, _, code = api.run([*options, str(file)])
    lines = {
        int(line.split(":")[1]): line for line in report.splitlines() if file.name in line and "error" in line
    }
    assert code == 1
    assert lines.keys() == ERRORS.keys(), report
    for number, words in ERRORS.items():
        assert words in lines[number]
