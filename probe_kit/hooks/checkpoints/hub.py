"""A quick test whether the hub can be reached, because its client retries for minutes. Imports no torch."""

from threading import Thread
from urllib.error import HTTPError
from urllib.request import Request, urlopen

PATIENCE = 5.0
"""Seconds without a reply after which the hub counts as unreachable."""


def unreachable() -> str:
    """Why the hub cannot be asked now; empty if it answers, whatever it says.

    A proxy that the environment names is used. Nothing is sent when the hub's own offline mode is on.
    """
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        return "offline mode (HF_HUB_OFFLINE)"
    found: list[str] = []
    asking = Thread(target=lambda: found.append(_ask(constants.ENDPOINT)), daemon=True)
    asking.start()
    asking.join(PATIENCE)  # looking a name up knows no time limit of its own
    return found[0] if found else _silence(constants.ENDPOINT)


def _ask(address: str) -> str:
    try:
        urlopen(Request(address, method="HEAD"), timeout=PATIENCE).close()
    except HTTPError:
        return ""  # it answered
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        return _silence(address) if isinstance(reason, TimeoutError) else f"{address} does not answer: {reason}"
    return ""


def _silence(address: str) -> str:
    return f"{address} did not answer within {PATIENCE:g} s"
