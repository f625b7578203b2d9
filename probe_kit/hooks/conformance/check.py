"""One check of the contract, and how it fails: what was seen, what was expected, what to change."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any
from unittest import SkipTest

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Check",
    "CheckFailedError",
    "SkipTest",
    "check",
    "checks_of",
    "refused",
    "require",
    "require_bits",
    "require_close",
]


class CheckFailedError(AssertionError):
    """An adapter does not do what a check expects.

    seen, expected: in words. change: what to do; empty where the advice of the check itself fits.
    """

    def __init__(self, seen: str, expected: str, change: str = "") -> None:
        super().__init__(f"seen: {seen}; expected: {expected}" + (f"; change: {change}" if change else ""))
        self.seen, self.expected, self.change = seen, expected, change


@dataclass(frozen=True)
class Check:
    """A promise that every adapter keeps.

    name: of the function. sentence: the promise. change: where to look in an adapter that does not keep it.
    body: takes a `Subject`; raises CheckFailedError, or SkipTest where the promise is not about this adapter.
    """

    name: str
    sentence: str
    change: str
    body: Callable[[Any], None]

    def __call__(self, subject: Any) -> None:
        """Check a `Subject`. Raises as `body` does, and whatever the adapter raises."""
        try:
            self.body(subject)
        except CheckFailedError as failed:
            if failed.change:
                raise
            raise CheckFailedError(failed.seen, failed.expected, self.change) from None


def check(sentence: str, change: str) -> Callable[[Callable[[Any], None]], Check]:
    """Decorate a function as a check; see `Check`."""

    def wrap(body: Callable[[Any], None]) -> Check:
        return Check(body.__name__, sentence, change, body)

    return wrap


def checks_of(*modules: ModuleType) -> tuple[Check, ...]:
    """The checks of modules, in the order in which they are written."""
    return tuple(own for module in modules for own in vars(module).values() if isinstance(own, Check))


def require(kept: bool, seen: str, expected: str, change: str = "") -> None:
    """Raise CheckFailedError unless `kept`."""
    if not kept:
        raise CheckFailedError(seen, expected, change)


def require_bits(seen: NDArray[Any], expected: NDArray[Any], name: str, like: str) -> None:
    """Raise CheckFailedError unless two arrays are equal, bit for bit. name, like: what they are."""
    if np.array_equal(seen, expected, equal_nan=True):
        return
    if seen.shape != expected.shape:
        raise CheckFailedError(f"{name} have the shape {seen.shape}", f"{expected.shape}, as {like}")
    apart = np.abs(seen.astype(np.float64) - expected.astype(np.float64)).max()
    raise CheckFailedError(f"{name} differ from {like} by up to {apart:.3g}", "no difference, bit for bit")


def require_close(seen: NDArray[Any], expected: NDArray[Any], tolerance: float, name: str) -> None:
    """Raise CheckFailedError unless two arrays are equal within `tolerance` plus 1e-7 of what is expected."""
    if not np.allclose(seen, expected, rtol=1e-7, atol=tolerance):
        raise CheckFailedError(
            f"{name} are off by {np.abs(seen - expected).max():.3g}", f"at most {tolerance:.3g}"
        )


@contextmanager
def refused(asked: str, *errors: type[Exception], says: str = "") -> Iterator[None]:
    """Raise CheckFailedError unless the body raises one of `errors`, whose message holds `says`."""
    named = " or ".join(error.__name__ for error in errors)
    try:
        yield
    except errors as error:
        require(
            says in str(error), f"{type(error).__name__}: {error}", f"a message about {asked} that says {says!r}"
        )
        return
    raise CheckFailedError(f"{asked}: no error", f"{named}" + (f" that says {says!r}" if says else ""))
