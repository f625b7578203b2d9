"""The commits of the hub's repositories that loading reads, and that a repetition reads. Imports no torch."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import MappingProxyType

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
