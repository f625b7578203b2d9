"""One check of the contract, and its outcome: what was seen, what was expected and what is to be changed."""

import os
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any, Literal
from unittest import SkipTest

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ProbeKitError
from probe_kit.hooks.checkpoints.third_party import contain_policy, in_words

__all__ = [
    "Check",
    "CheckFailedError",
    "CheckOutcome",
    "SkipTest",
    "check",
    "checks_of",
    "expect_refusal",
    "require",
    "require_bits",
    "require_close",
    "try_check",
]


class CheckFailedError(AssertionError):
    """An adapter does not do what a check expects.

    Args:
        actual: The behaviour that was seen, in words.
        expected: The behaviour that was expected, in words.
        change: Advice on what to do; empty where the advice of the check itself fits.
    """

    def __init__(self, actual: str, expected: str, change: str = "") -> None:
        super().__init__(f"seen: {actual}; expected: {expected}" + (f"; change: {change}" if change else ""))
        self.actual, self.expected, self.change = actual, expected, change


@dataclass(frozen=True)
class Check:
    """A promise that every adapter keeps.

    Attributes:
        name: Name of the function.
        sentence: The promise.
        change: The place to look at in an adapter that does not keep it.
        body: Takes a `Subject`; raises CheckFailedError, or SkipTest where the promise is not about this adapter.
    """

    name: str
    sentence: str
    change: str
    body: Callable[[Any], None]

    def __str__(self) -> str:
        return self.name

    def __call__(self, subject: Any) -> None:
        """Check a `Subject`; raises as `body` does, and whatever the adapter raises."""
        try:
            self.body(subject)
        except CheckFailedError as failed:
            if failed.change:
                raise
            raise CheckFailedError(failed.actual, failed.expected, self.change) from None


def check(sentence: str, change: str) -> Callable[[Callable[[Any], None]], Check]:
    """Decorate a function as a check; see `Check`."""

    def wrap(body: Callable[[Any], None]) -> Check:
        return Check(body.__name__, sentence, change, body)

    return wrap


def checks_of(*modules: ModuleType) -> tuple[Check, ...]:
    """The checks of modules, in the order in which they are written."""
    return tuple(value for module in modules for value in vars(module).values() if isinstance(value, Check))


def require(condition: bool, actual: str, expected: str, change: str = "") -> None:
    """Raise CheckFailedError unless `condition` holds."""
    if not condition:
        raise CheckFailedError(actual, expected, change)


def require_bits(actual: NDArray[Any], expected: NDArray[Any], name: str, like: str) -> None:
    """Raise CheckFailedError unless two arrays are equal, bit for bit; `name` and `like` say what they are."""
    if np.array_equal(actual, expected, equal_nan=True):
        return
    if actual.shape != expected.shape:
        raise CheckFailedError(f"{name} have the shape {actual.shape}", f"{expected.shape}, as {like}")
    apart = np.abs(actual.astype(np.float64) - expected.astype(np.float64)).max()
    raise CheckFailedError(f"{name} differ from {like} by up to {apart:.3g}", "no difference, bit for bit")


def require_close(actual: NDArray[Any], expected: NDArray[Any], tolerance: float, name: str) -> None:
    """Raise CheckFailedError unless two arrays are equal within `tolerance` plus 1e-7 of what is expected."""
    if not np.allclose(actual, expected, rtol=1e-7, atol=tolerance):
        raise CheckFailedError(
            f"{name} are off by {np.abs(actual - expected).max():.3g}", f"at most {tolerance:.3g}"
        )


@contextmanager
def expect_refusal(request: str, *errors: type[Exception], says: str = "") -> Iterator[None]:
    """Raise CheckFailedError unless the body raises one of `errors`, whose message holds `says`."""
    classes = " or ".join(error.__name__ for error in errors)
    try:
        yield
    except errors as error:
        require(
            says in str(error), f"{type(error).__name__}: {error}", f"a message about {request} that says {says!r}"
        )
        return
    raise CheckFailedError(f"{request}: no error", f"{classes}" + (f" that says {says!r}" if says else ""))


# -- what came of it ---------------------------------------------------------------------------------------

State = Literal["passed", "failed", "skipped"]
_FROM_THE_ERROR = "no error"


@dataclass(frozen=True)
class CheckOutcome:
    """The outcome of one check.

    Attributes:
        sentence: The promise that was checked.
        actual: The behaviour that was seen, in words; "" for a check that did not fail.
        expected: The behaviour that was expected, in words; "" for a check that did not fail.
        change: Advice on what to change; "" for a check that did not fail.
        reason: The reason of a skip; "" for a check that was not skipped.
    """

    name: str
    state: State
    sentence: str
    actual: str = ""
    expected: str = ""
    change: str = ""
    reason: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return plain values, as `probe-kit check-adapter --json` prints them."""
        return asdict(self)


def try_check(name: str, sentence: str, change: str, body: Callable[[], object], package: str) -> CheckOutcome:
    """Run a check; whatever the adapter raises is a failure.

    Ctrl-C is raised. Changes of the adapter in this process are put back.

    Args:
        name: Name of the check.
        sentence: The promise that is checked.
        change: Advice on what to change, where the failure brings none of its own.
        body: Runs the check.
        package: Package of the adapter, to name the place of its error.
    """
    try:
        with contain_policy() as interruptions:
            body()
    except SkipTest as skipped:
        return CheckOutcome(name, "skipped", sentence, reason=str(skipped))
    except CheckFailedError as failed:
        return CheckOutcome(name, "failed", sentence, failed.actual, failed.expected, failed.change or change)
    except BaseException as error:  # some of these end a process, and are the adapter's own here
        if isinstance(error, KeyboardInterrupt) and interruptions.asked:
            raise
        return CheckOutcome(name, "failed", sentence, _in_words(error, package), _FROM_THE_ERROR, change)
    return CheckOutcome(name, "passed", sentence)


def _in_words(error: BaseException, package: str) -> str:
    """Return the whole text of an error of ours, the first line of any other, and the adapter's line it passed."""
    cause = error.__cause__
    if isinstance(error, ProbeKitError) and cause is not None and not isinstance(cause, ProbeKitError):
        return _in_words(cause, package) if place_of(cause, package) else f"{type(error).__name__}: {error}"
    text = in_words(error)
    if isinstance(error, ProbeKitError):
        text = "; ".join([f"{type(error).__name__}: {error}", *getattr(error, "__notes__", [])])
    line = place_of(error, package)
    return f"{text} ({line})" if line else text


def place_of(error: BaseException, package: str) -> str:
    """File and line of the last frame of `package` that an error passed; empty if it passed none."""
    inside = [
        (frame.f_code.co_filename, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
        if f"{frame.f_globals.get('__name__', '')}.".startswith(f"{package}.")
    ]
    if not inside:
        return ""
    file, line = inside[-1]
    near = os.path.relpath(file)
    return f"{file if near.startswith('..') else near}:{line}"


def package_of(loader: str) -> str:
    """Return the package of a family's `loader`: `my_vla` of `my_vla.loading:load`."""
    module = loader.partition(":")[0]
    return module.rpartition(".")[0] or module
