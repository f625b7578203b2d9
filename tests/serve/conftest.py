"""A small policy, and sessions of it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from probe_kit.hooks import Policy, load_policy
from probe_kit.serve.server import Server, open_server
from probe_kit.serve.session import Line
from tests.support.served_sessions import Opens, settings


@pytest.fixture(scope="package")
def policy() -> Policy:
    return load_policy("pi0-tiny")


@pytest.fixture
def opened(policy: Policy, tmp_path: Path) -> Iterator[Opens]:
    """Open servers that are not started; each keeps its lines."""
    servers: list[Server] = []

    def server(out: str = "run", lines: list[Line] | None = None, token: str = "", **choices: Any) -> Server:
        report = [] if lines is None else lines
        file = None
        if token:
            file = tmp_path / "token"
            file.write_text(token, encoding="utf-8")
        where = str(tmp_path / out)
        new_server = open_server(settings(**choices), where, "127.0.0.1", 0, file, {}, report.append, policy)
        servers.append(new_server)
        return new_server

    yield server
    for started in servers:
        started.listener.close()
