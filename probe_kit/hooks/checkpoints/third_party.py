"""Calls of third-party code: its errors get the names of model and checkpoint, and its side effects are undone.

A policy of a third party runs in the process that plays and writes other episodes too. After every call these are
restored: random numbers, torch's default dtype, the working directory, environment variables, and the handling of
Ctrl-C. What the code prints is shown as text on stderr. This guards against accidents, not against intent; see
SECURITY.md.
"""

import logging
import os
import random
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from importlib import import_module
from io import TextIOBase
from operator import attrgetter
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

import numpy as np
from rich.file_proxy import FileProxy

from probe_kit._system.bounded_files import check_no_pointers, recorded_files
from probe_kit._system.escaping import terminal_safe
from probe_kit._system.foreign_files import reason_of
from probe_kit._system.imports import one_scan_of_packages
from probe_kit._system.machine import is_out_of_memory
from probe_kit.errors import CheckpointError, InstructionError, PolicyFailedError, ProbeKitError, WeightsError
from probe_kit.hooks.checkpoints.folders import with_adapters_named
from probe_kit.hooks.contract.observation import Observation

_ENDING = (signal.SIGINT, signal.SIGTERM)


class Interruptions:
    """A record of interruptions of this process while a policy worked.

    It tells them from a KeyboardInterrupt that the policy raises itself.
    """

    def __init__(self) -> None:
        self.asked = False


@contextmanager
def contain_policy(limit: float | None = None) -> Iterator[Interruptions]:
    """Run a policy's code in the body; afterwards this process is as it was.

    A process that the body forked ends here: it would play on beside its parent, into the same run.

    Args:
        limit: Seconds after which the process is ended by SIGALRM, which no code can hold up; None for no limit.
    """
    process = os.getpid()
    try:
        with ExitStack() as stack:
            stack.enter_context(_kept_randomness())
            stack.enter_context(_kept_surroundings())
            stack.enter_context(_quoted_output())
            interruptions = stack.enter_context(_noted_interruptions())
            if limit is not None:
                signal.setitimer(signal.ITIMER_REAL, limit)
            yield interruptions
    finally:
        if os.getpid() != process:
            os._exit(1)
        if limit is not None:
            signal.setitimer(signal.ITIMER_REAL, 0)


def begin_randomness(seed: int) -> None:
    """Let the global random numbers of Python, NumPy and torch begin at `seed` (63 bits).

    A policy that draws from them then depends on its episodes alone, and not on what was played before.
    """
    import torch

    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002
    if torch.accelerator.is_available():
        torch.manual_seed(seed)
    else:
        # The former would write down three stack traces, for GPUs that are not there: 1 ms deep in a run.
        torch.default_generator.manual_seed(seed)


def copy_observations(observations: Sequence[Observation]) -> list[Observation]:
    """Return observations whose arrays may be written to: those of the stage stay as they are."""
    return [
        replace(
            observation,
            image=np.array(observation.image),
            state=np.array(observation.state),
            intrinsics=None if observation.intrinsics is None else np.array(observation.intrinsics),
            cameras={name: np.array(picture) for name, picture in observation.cameras.items()},
        )
        for observation in observations
    ]


@contextmanager
def _kept_randomness() -> Iterator[None]:
    import torch

    on_gpu: bool = torch.cuda.is_initialized()  # type: ignore[no-untyped-call]
    python, numpy, host = random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
    devices = torch.cuda.get_rng_state_all() if on_gpu else []
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002
        torch.set_rng_state(host)
        if on_gpu:
            torch.cuda.set_rng_state_all(devices)


@contextmanager
def _kept_surroundings() -> Iterator[None]:
    """Restore torch's default dtype, the working directory and the environment variables after the body."""
    import torch

    dtype, folder, variables = torch.get_default_dtype(), os.open(".", os.O_RDONLY), dict(os.environ)
    try:
        yield
    finally:
        torch.set_default_dtype(dtype)
        os.fchdir(folder)
        os.close(folder)
        for name in os.environ.keys() - variables.keys():
            del os.environ[name]
        os.environ.update({name: value for name, value in variables.items() if os.environ.get(name) != value})


class _Quoted(TextIOBase):
    """Writes to another stream; control characters that a terminal would obey become visible signs."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        self._stream.write(terminal_safe(text))
        return len(text)

    def flush(self) -> None:
        self._stream.flush()

    def isatty(self) -> bool:
        return False

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return self._stream.encoding


@contextmanager
def _quoted_output() -> Iterator[None]:
    """Redirect Python's output to stderr as text; stdout is for results.

    While a progress bar is drawn, both are rich's already, and what it prints ends in our consoles.
    """
    if isinstance(sys.stdout, FileProxy) or isinstance(sys.stderr, FileProxy) or sys.stderr is None:
        yield
        return
    quoted = _Quoted(sys.stderr)
    with redirect_stdout(quoted), redirect_stderr(quoted):
        yield


@contextmanager
def _noted_interruptions() -> Iterator[Interruptions]:
    """Record Ctrl-C and SIGTERM before their handlers run; only the main thread can."""
    interruptions = Interruptions()
    before: dict[int, Callable[[int, FrameType | None], Any]] = {}

    def note(number: int, frame: FrameType | None) -> None:
        interruptions.asked = True
        before[number](number, frame)

    try:
        for number in _ENDING:
            if callable(handler := signal.getsignal(number)):
                before[number] = handler
                signal.signal(number, note)
    except ValueError:  # another thread, where KeyboardInterrupt comes from code alone
        before.clear()
    try:
        yield interruptions
    finally:
        for ending, handler in before.items():
            signal.signal(ending, handler)


# -- names of errors ------------------------------------------------------------------------------------------


@contextmanager
def naming_checkpoint(model: str, location: str) -> Iterator[None]:
    """Put the model and the checkpoint's folder or hub id into the body's errors about weights, files and words.

    A name that a message holds already is not repeated.
    """
    try:
        yield
    except (CheckpointError, WeightsError, InstructionError) as error:  # the last of a tokenizer that lacks words
        error.args = (with_origin(str(error), model, location),)
        raise


def with_origin(reason: str, model: str, location: str) -> str:
    """A reason why a checkpoint cannot be used, with the names of its model and place unless it holds them."""
    reason = with_adapters_named(reason)
    places = {location, str(Path(location))}
    remainder = reason
    for spelling in places:
        remainder = remainder.replace(spelling, " ")  # a folder may be called as its model is
    lacking = [] if re.search(rf"(?<![\w-]){re.escape(model)}(?![\w-])", remainder) else [model]
    if remainder == reason:
        lacking.append(location)
    return f"{' from '.join(lacking)}: {reason}" if lacking else reason


@contextmanager
def while_acting(model: str, location: str, limit: float | None = None) -> Iterator[None]:
    """Turn errors of a policy's code in the body into errors of ours.

    Args:
        model: Name of the model.
        location: The place of its checkpoint, for errors of the checkpoint that show this late.
        limit: Seconds after which the process is ended, as in `contain_policy`; None for no limit.

    Raises:
        PolicyFailedError: For any error but one of ours, or of memory that ended, which are raised as they are; it
            names the model.
    """
    with contain_policy(limit) as interruptions:
        try:
            with naming_checkpoint(model, location):
                yield
        except ProbeKitError:
            raise
        except BaseException as error:  # some of these end a process, and are the policy's own here
            if (isinstance(error, KeyboardInterrupt) and interruptions.asked) or is_out_of_memory(error):
                raise
            raise PolicyFailedError(
                f"{model} failed while it acted: {in_words(error)}. Its code must give actions or raise an error "
                f"of probe_kit; fix it, or what it read from {location}. Then run the same command to resume"
            ) from error


_MOST_FILES = 8
"""The most files that an error of loading names: those that were read last, because one of them may be damaged."""


@contextmanager
def while_loading(model: str, location: str) -> Iterator[None]:
    """Turn errors of a loader's code in the body into errors of ours.

    Args:
        model: Name of the model.
        location: The folder or hub id of its checkpoint.

    Raises:
        CheckpointError: For any error but one of ours, or of memory that ended, which are raised as they are; it
            names model and checkpoint.
        PolicyFailedError: For a loader that ends the process.
    """
    try:
        with (
            _said_when_asked_for("bitsandbytes"),
            naming_checkpoint(model, location),
            recorded_files() as files,
        ):
            yield
    except ProbeKitError:
        raise
    except SystemExit as error:
        raise PolicyFailedError(f"{model} cannot be loaded: its code called sys.exit({error.code!r})") from error
    except Exception as error:
        if is_out_of_memory(error):
            raise
        check_no_pointers(Path(location).expanduser())
        latest = list(dict.fromkeys(path.name for path in reversed(files)))[:_MOST_FILES]
        read = f" (it had read {', '.join(latest)})" if latest else ""
        raise CheckpointError(
            f"{model} cannot be loaded from {location}: {in_words(error)}. A file of the checkpoint is damaged"
            f"{read}, or was made for another version; download it again"
        ) from error


def import_object(path: str) -> Any:
    """Return the object at `module:name` or `module:Class.method`."""
    module, name = path.split(":")
    return attrgetter(name)(import_module(module))


def import_loader(model: str, path: str) -> Callable[..., Any]:
    """Return a function of a family's code, see `import_object`. Raises as `while_loading`."""
    with while_loading(model, path), one_scan_of_packages():
        function: Callable[..., Any] = import_object(path)
    return function


@contextmanager
def _said_when_asked_for(library: str) -> Iterator[None]:
    """Silence the warnings of a library that others import wherever it is installed.

    Code that asks for the library gets its errors.
    """
    logger = logging.getLogger(library)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def in_words(error: BaseException) -> str:
    """Return the class and the first line of an error, and of the error that it was raised from."""
    return f"it called sys.exit({error.code!r})" if isinstance(error, SystemExit) else reason_of(error)
