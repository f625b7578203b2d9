"""Calls of third-party code: every exception, even SystemExit, becomes an error of probe_kit.

What is wrong with a checkpoint says whose it is and where it lies, wherever in the loading or acting it was found.
"""

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from probe_kit.errors import CheckpointError, InstructionError, PolicyFailedError, ProbeKitError, WeightsError
from probe_kit.hooks.checkpoints.adapter_files import with_adapters_named
from probe_kit.hooks.checkpoints.containment import contained

_LONGEST = 300


@contextmanager
def naming_checkpoint(model: str, location: str) -> Iterator[None]:
    """Put the model and the checkpoint's folder or hub id into the body's errors about weights, files and words.

    What a message already names is not said twice.
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
    """Errors of a policy's code in the body. Raises PolicyFailedError naming the model, or an error of ours.

    location: where its checkpoint lies, for what is found out about it this late. limit: as `contained` has it.
    """
    with contained(limit) as interruptions:
        try:
            with naming_checkpoint(model, location):
                yield
        except ProbeKitError:
            raise
        except BaseException as error:  # some of these end a process, and are the policy's own here
            if isinstance(error, KeyboardInterrupt) and interruptions.asked:
                raise
            raise PolicyFailedError(
                f"{model} failed while it acted: {in_words(error)}. Its code must give actions or raise an error "
                f"of probe_kit; fix it, or what it read from {location}. Then run the same command to resume"
            ) from error


@contextmanager
def while_loading(model: str, location: str) -> Iterator[None]:
    """Errors of a loader's code in the body. Raises CheckpointError naming model and checkpoint, or one of ours.

    A loader that ends the process raises PolicyFailedError.
    """
    try:
        with _said_when_asked_for("bitsandbytes"), naming_checkpoint(model, location):
            yield
    except ProbeKitError:
        raise
    except SystemExit as error:
        raise PolicyFailedError(f"{model} cannot be loaded: its code called sys.exit({error.code!r})") from error
    except Exception as error:
        raise CheckpointError(
            f"{model} cannot be loaded from {location}: {in_words(error)}. A file of the checkpoint is damaged, "
            "or was made for another version; download it again"
        ) from error


@contextmanager
def _said_when_asked_for(library: str) -> Iterator[None]:
    """No warnings of a library that others import wherever it is installed; who asks for it gets its errors."""
    logger = logging.getLogger(library)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def in_words(error: BaseException) -> str:
    """Class and first line."""
    if isinstance(error, SystemExit):
        return f"it called sys.exit({error.code!r})"
    first = (str(error).strip().splitlines() or ["no message"])[0]
    return f"{type(error).__name__}: {first[:_LONGEST]}"
