"""Errors out of code of others, and of checkpoints, say whose they are."""

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager

import pytest

from probe_kit.errors import (
    CheckpointError,
    InstructionError,
    PolicyFailedError,
    ProbeKitError,
    UsageError,
    WeightsError,
)
from probe_kit.hooks.checkpoints.third_party import while_acting, while_loading, with_origin


@pytest.mark.parametrize("context", [while_loading, while_acting], ids=["loading", "acting"])
@pytest.mark.parametrize("kind", [CheckpointError, WeightsError, InstructionError])
def test_an_error_about_a_checkpoint_names_its_family_and_its_folder(
    context: Callable[[str, str], AbstractContextManager[None]], kind: type[ProbeKitError]
) -> None:
    expected = r"^pi0 from /models/mine: normalisation 7 is not one of MEAN_STD$"
    with pytest.raises(kind, match=expected) as raised, context("pi0", "/models/mine"):
        raise kind("normalisation 7 is not one of MEAN_STD")
    assert type(raised.value) is kind


@pytest.mark.parametrize(
    ("reason", "expected"),
    [
        ("/models/mine/config.json is missing", "pi0: /models/mine/config.json is missing"),
        ("pi0 has no such key", "/models/mine: pi0 has no such key"),
        ("pi0-tiny has no such key", "pi0 from /models/mine: pi0-tiny has no such key"),
        ("pi0 cannot be loaded from /models/mine: x", "pi0 cannot be loaded from /models/mine: x"),
    ],
)
def test_what_a_message_names_already_is_not_said_twice(reason: str, expected: str) -> None:
    assert with_origin(reason, "pi0", "/models/mine") == expected
    assert with_origin(expected, "pi0", "/models/mine") == expected


def test_a_slash_at_the_end_makes_no_other_folder() -> None:
    assert with_origin("pi0: /models/mine/x is gone", "pi0", "/models/mine/") == "pi0: /models/mine/x is gone"


def test_a_folder_called_like_the_model_is_not_its_name() -> None:
    expected = with_origin("/golden/pi0/checkpoint/config.json is missing", "pi0", "/golden/pi0/checkpoint")
    assert expected == "pi0: /golden/pi0/checkpoint/config.json is missing"


def test_other_errors_of_ours_are_left_as_they_are() -> None:
    with pytest.raises(UsageError, match=r"^device 'x' cannot be used$"), while_loading("pi0", "/models/mine"):
        raise UsageError("device 'x' cannot be used")


def test_errors_of_others_and_an_end_of_the_process_are_named() -> None:
    with (
        pytest.raises(CheckpointError, match=r"pi0 cannot be loaded from /x: KeyError: 'a'"),
        while_loading("pi0", "/x"),
    ):
        raise KeyError("a")
    with pytest.raises(PolicyFailedError, match=r"sys\.exit\(3\)"), while_loading("pi0", "/x"):
        raise SystemExit(3)
    with pytest.raises(PolicyFailedError, match=r"pi0 failed while it acted: KeyError"), while_acting("pi0", "/x"):
        raise KeyError("a")


def test_a_library_that_is_only_there_does_not_speak_while_a_model_loads(caplog: pytest.LogCaptureFixture) -> None:
    """Libraries import bitsandbytes wherever it is installed, and it complains where there is no GPU."""
    theirs = logging.getLogger("bitsandbytes.cextension")
    with while_loading("pi0", "/x"):
        theirs.warning("compiled without GPU support")
        theirs.error("broken")
    theirs.warning("afterwards")
    assert [record.message for record in caplog.records] == ["broken", "afterwards"]
