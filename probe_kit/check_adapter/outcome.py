"""What came of a check: passed, failed or skipped, with what was seen, what was expected and what to change."""

import os
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from probe_kit.errors import ProbeKitError
from probe_kit.hooks.checkpoints.containment import contained
from probe_kit.hooks.checkpoints.third_party import in_words
from probe_kit.hooks.conformance.check import CheckFailedError, SkipTest

State = Literal["passed", "failed", "skipped"]
_FROM_THE_ERROR = "no error"


@dataclass(frozen=True)
class Outcome:
    """What came of one check.

    sentence: the promise that was checked. seen, expected, change: of a failure, in words. reason: of a skip.
    """

    name: str
    state: State
    sentence: str
    seen: str = ""
    expected: str = ""
    change: str = ""
    reason: str = ""

    def to_json(self) -> dict[str, Any]:
        """As `probe-kit check-adapter --json` prints it."""
        return asdict(self)


def tried(name: str, sentence: str, change: str, body: Callable[[], None], package: str) -> Outcome:
    """Run a check; whatever the adapter raises is a failure. Ctrl-C is raised.

    package: of the adapter, to name the place of its error. What it changes in this process is put back.
    """
    try:
        with contained() as interruptions:
            body()
    except SkipTest as skipped:
        return Outcome(name, "skipped", sentence, reason=str(skipped))
    except CheckFailedError as failed:
        return Outcome(name, "failed", sentence, failed.seen, failed.expected, failed.change or change)
    except BaseException as error:  # some of these end a process, and are the adapter's own here
        if isinstance(error, KeyboardInterrupt) and interruptions.asked:
            raise
        return Outcome(name, "failed", sentence, _in_words(error, package), _FROM_THE_ERROR, change)
    return Outcome(name, "passed", sentence)


def _in_words(error: BaseException, package: str) -> str:
    """All of an error of ours, the first line of any other, and the line of the adapter that it passed."""
    cause = error.__cause__
    if isinstance(error, ProbeKitError) and cause is not None and not isinstance(cause, ProbeKitError):
        return _in_words(cause, package) if place_of(cause, package) else f"{type(error).__name__}: {error}"
    said = in_words(error)
    if isinstance(error, ProbeKitError):
        said = "; ".join([f"{type(error).__name__}: {error}", *getattr(error, "__notes__", [])])
    place = place_of(error, package)
    return f"{said} ({place})" if place else said


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
    """The package of a family's `loader`: `my_vla` of `my_vla.loading:load`."""
    module = loader.partition(":")[0]
    return module.rpartition(".")[0] or module


def folder_size(folder: Path) -> int:
    """Bytes of all files of a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
