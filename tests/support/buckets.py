"""Buckets on an S3 server of our own, started by the tests that need one."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.support.s3_server import BadServer, S3Server, empty_bucket, server_elsewhere, without_conditions


@contextmanager
def _leading_to(server: S3Server, patch: pytest.MonkeyPatch) -> Iterator[str]:
    """The URL of an empty bucket, which the environment then leads to."""
    for name, value in server.environment.items():
        patch.setenv(name, value)
    try:
        yield server.empty()
    finally:
        server.stop()


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """URL of an empty bucket on a server that does what S3 does."""
    with _leading_to(S3Server(), monkeypatch) as url:
        yield url


@pytest.fixture
def deaf_bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """URL of an empty bucket on a server that ignores If-None-Match; some S3-compatible stores do."""
    with _leading_to(S3Server(without_conditions), monkeypatch) as url:
        yield url


@pytest.fixture
def bad_server(monkeypatch: pytest.MonkeyPatch) -> Iterator[BadServer]:
    """A server that fails on demand, and can be stopped and started; its bucket is `bad_server.url`."""
    server = BadServer()
    with _leading_to(server, monkeypatch) as server.url:
        yield server
        server.day.over.set()


@pytest.fixture
def bucket_elsewhere(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """URL of an empty bucket on a server in a process of its own, which the environment leads to."""
    with server_elsewhere() as environment:
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        yield empty_bucket(environment)
