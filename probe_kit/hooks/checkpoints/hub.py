"""The reachability of the hub, whose client retries for minutes, its refusals, and the commits that are read.

Imports no torch.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Thread
from types import MappingProxyType
from urllib.error import HTTPError
from urllib.request import Request, urlopen

PATIENCE = 5.0
"""Seconds without a reply after which the hub counts as unreachable."""
OFFLINE_WAY_OUT = "Connect to the network once, or fill the cache with `hf download`"
"""What to do where the hub cannot be asked."""
_WITHOUT_NETWORK = ContextVar("without_network", default=False)


@contextmanager
def without_network() -> Iterator[None]:
    """A context in which only the cache of the hub is read, as for a plan."""
    token = _WITHOUT_NETWORK.set(True)
    try:
        yield
    finally:
        _WITHOUT_NETWORK.reset(token)


def unreachable() -> str:
    """Why the hub cannot be asked now; empty if it answers, whatever it says.

    A proxy that the environment names is used. Nothing is sent when the hub's own offline mode is on.
    """
    if _WITHOUT_NETWORK.get():
        return "a plan asks no network"
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        return "offline mode (HF_HUB_OFFLINE)"
    replies: list[str] = []
    asking = Thread(target=lambda: replies.append(_ask(constants.ENDPOINT)), daemon=True)
    asking.start()
    asking.join(PATIENCE)  # looking a name up knows no time limit of its own
    return replies[0] if replies else _silence(constants.ENDPOINT)


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


def hub_reason(error: Exception) -> str:
    """Why the hub delivers nothing, in words: its client reports several reasons by one exception."""
    from huggingface_hub import errors, get_token

    cause = _cause(error)
    status = _status(cause)
    message = str(getattr(cause, "server_message", None) or error)  # the hub's own words, where it answered
    first = (message.strip().splitlines() or [type(error).__name__])[0]
    if isinstance(cause, errors.GatedRepoError):
        return "its authors give access on request (gated), and yours is not granted"
    if isinstance(cause, errors.DisabledRepoError):
        return "the hub has disabled it"
    if isinstance(cause, errors.RevisionNotFoundError):
        return f"it has no such revision: {first}"
    if status == 401 and get_token():
        return "the hub refuses your token (401): it is expired, revoked or mistyped"
    if isinstance(cause, errors.RepositoryNotFoundError):
        hidden = "your token does not open it" if get_token() else "no token is set"
        return f"there is no such repository, or it is private and {hidden}"
    if isinstance(cause, errors.EntryNotFoundError) and not isinstance(cause, errors.LocalEntryNotFoundError):
        return f"the repository lacks a file: {first}"
    return f"the hub answers {status}: {first}" if status else first


def way_out(error: Exception) -> str:
    """Return advice on a refusal of the hub."""
    from huggingface_hub import errors, get_token

    cause = _cause(error)
    if isinstance(cause, errors.GatedRepoError):
        return "Ask for access on the model's page" if get_token() else "Run `hf auth login`"
    if isinstance(cause, errors.RevisionNotFoundError):
        return "Look the branches, tags and commits up on its page"
    if _status(cause) == 401 and get_token():
        return "Run `hf auth login` with a new token, or `hf auth logout` for a public model"
    if isinstance(cause, errors.RepositoryNotFoundError):
        return "Check the name, and run `hf auth login` for a private model"
    return "Check the name, your network and, for gated models, `hf auth login`"


def _cause(error: BaseException) -> BaseException:
    """The refusal behind an error of the cache: the client looks there when the hub refuses."""
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError

    cause = error.__cause__
    return cause if isinstance(error, LocalEntryNotFoundError) and isinstance(cause, HfHubHTTPError) else error


def _status(error: BaseException) -> int | None:
    """The status of an answer; None for an error without one."""
    status: int | None = getattr(getattr(error, "response", None), "status_code", None)
    return status


# -- commits ---------------------------------------------------------------------------------------------

_PINNED: ContextVar[Mapping[str, str]] = ContextVar("pinned", default=MappingProxyType({}))
_RECORDED: ContextVar[dict[str, str] | None] = ContextVar("recorded", default=None)


@contextmanager
def pinned_commits(commits: Mapping[str, str]) -> Iterator[None]:
    """A context in which repositories are read at these commits, by name, unless a revision is asked for."""
    token = _PINNED.set({**_PINNED.get(), **commits})
    try:
        yield
    finally:
        _PINNED.reset(token)


@contextmanager
def recorded_commits() -> Iterator[dict[str, str]]:
    """A context whose value gets the commit of every repository of the hub that is read inside, by name."""
    commits: dict[str, str] = {}
    token = _RECORDED.set(commits)
    try:
        yield commits
    finally:
        _RECORDED.reset(token)


def pinned_commit(repository: str) -> str:
    """Return the commit at which a repository is to be read; empty where any is fine."""
    return _PINNED.get().get(repository, "")


def record_commit(repository: str, commit: str) -> None:
    """Note that files of a commit were read."""
    if (commits := _RECORDED.get()) is not None:
        commits[repository] = commit
