"""Calling code of others: whatever it raises, even the end of the process, becomes a named error of ours."""

from collections.abc import Iterator
from contextlib import contextmanager

from probe_kit.errors import CheckpointError, PolicyFailedError, ProbeKitError

_LONGEST = 300


@contextmanager
def acting(model: str) -> Iterator[None]:
    """Errors of a policy's code in the body. Raises PolicyFailedError naming the model, or an error of ours."""
    try:
        yield
    except ProbeKitError:
        raise
    except (Exception, SystemExit) as error:
        raise PolicyFailedError(
            f"{model} failed while it acted: {in_words(error)}. Its code must give actions or raise an error of "
            "probe_kit; mend it, then the same command continues"
        ) from error


@contextmanager
def loading(model: str, place: str) -> Iterator[None]:
    """Errors of a loader's code in the body. Raises CheckpointError naming model and checkpoint, or one of ours.

    A loader that ends the process raises PolicyFailedError.
    """
    try:
        yield
    except ProbeKitError:
        raise
    except SystemExit as error:
        raise PolicyFailedError(f"{model} cannot be loaded: its code called sys.exit({error.code!r})") from error
    except Exception as error:
        raise CheckpointError(
            f"{model} cannot be loaded from {place}: {in_words(error)}. A file of the checkpoint is damaged, or "
            "was made for another version; download it again"
        ) from error


def in_words(error: BaseException) -> str:
    """Class and first line."""
    if isinstance(error, SystemExit):
        return f"it called sys.exit({error.code!r})"
    first = (str(error).strip().splitlines() or ["no message"])[0]
    return f"{type(error).__name__}: {first[:_LONGEST]}"
