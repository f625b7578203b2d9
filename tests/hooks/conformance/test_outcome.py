"""Whatever an adapter does in a check becomes one outcome in words; Ctrl-C ends the command."""

import os
import signal
from pathlib import Path

import pytest

from probe_kit.errors import CheckpointError
from probe_kit.hooks.conformance.check import CheckFailedError, Outcome, SkipTest, package_of, place_of, tried


def of(error: BaseException | None) -> Outcome:
    def body() -> None:
        if error is not None:
            raise error

    return tried("name", "A promise.", "Do it.", body, "tests.hooks.conformance")


def test_no_error_is_passed_and_a_skip_has_its_reason() -> None:
    assert of(None) == Outcome("name", "passed", "A promise.")
    assert of(SkipTest("no kv")) == Outcome("name", "skipped", "A promise.", reason="no kv")


def test_a_failure_has_what_was_seen_expected_and_to_be_changed() -> None:
    assert of(CheckFailedError("this", "that")) == Outcome(
        "name", "failed", "A promise.", "this", "that", "Do it."
    )
    assert of(CheckFailedError("this", "that", "Do that.")).change == "Do that."


@pytest.mark.parametrize("error", [ValueError("odd"), SystemExit(3), KeyboardInterrupt("mine"), MemoryError()])
def test_whatever_an_adapter_raises_is_a_failure_that_names_its_line(error: BaseException) -> None:
    found = of(error)
    assert (found.state, found.change) == ("failed", "Do it.")
    assert "sys.exit(3)" in found.actual or type(error).__name__ in found.actual
    assert f"{Path(__file__).name}:" in found.actual


def test_an_error_of_ours_is_told_whole_with_its_notes() -> None:
    error = CheckpointError("the file is torn")
    error.add_note("part 2 of 3")
    assert of(error).actual.startswith("CheckpointError: the file is torn; part 2 of 3 (")


def test_what_a_loader_raised_is_told_in_place_of_the_advice_to_download_again() -> None:
    error = CheckpointError("cannot be loaded; download it again")
    try:
        raise ValueError("width 3")
    except ValueError as cause:
        error.__cause__ = cause
    assert of(error).actual.startswith("ValueError: width 3 (")


def test_ctrl_c_ends_the_command() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    try:
        with pytest.raises(KeyboardInterrupt):
            tried("name", "A promise.", "Do it.", lambda: os.kill(os.getpid(), signal.SIGINT), "tests")
    finally:
        signal.signal(signal.SIGINT, before)


def test_what_an_adapter_changed_in_the_process_is_put_back() -> None:
    folder = Path.cwd()
    tried("name", "A promise.", "Do it.", lambda: os.chdir("/"), "tests")
    assert Path.cwd() == folder


def test_the_place_is_that_of_the_adapters_own_code() -> None:
    assert package_of("my_vla.loading:load") == "my_vla"
    assert package_of("my_adapter:load") == "my_adapter"
    assert package_of("probe_kit.hooks.families.pi0.adapter:load") == "probe_kit.hooks.families.pi0"
    with pytest.raises(ValueError, match="x") as raised:
        int("x")
    assert place_of(raised.value, "somewhere.else") == ""
    assert f"{Path(__file__).name}:" in place_of(raised.value, __name__)
