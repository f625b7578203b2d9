"""The wire of openpi, spoken by a client of the package websockets."""

import http.client
import resource
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, ConnectionClosedError, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from probe_kit.hooks import Policy
from probe_kit.serve.codec import pack, unpack
from tests.support.served_sessions import WORDS, Opens, observation, serving

MARK = "probe_kit/episode"
PATIENCE = 120
"""The seconds that an answer may take: the machine of a test may be busy."""


def ask(connection: ClientConnection, message: dict[str, Any]) -> Any:
    connection.send(pack(message))
    answer = connection.recv(PATIENCE)
    return answer if isinstance(answer, str) else unpack(answer)


def test_a_client_plays_an_episode_and_an_error_leaves_its_connection_open(opened: Opens) -> None:
    server = opened(captured_calls=1)
    with serving(server, stop_after=1) as address, connect(f"{address}/arm-1", compression=None) as client:
        assert unpack(client.recv(PATIENCE))["probe_kit"]["mark"] == MARK
        first = ask(client, {**observation(0), MARK: {"id": "a"}})
        assert first["actions"].dtype == np.float32
        assert first["actions"].ndim == 2
        assert set(first) == {"actions", "server_timing"}  # a client slices every other array too
        refused = ask(client, {"prompt": WORDS, MARK: {"id": "a"}})
        assert refused.startswith("ObservationError: the observation has no picture 'observation/image'")
        assert len(refused.splitlines()) == 1
        second = ask(client, {**observation(1), MARK: {"id": "a"}})
        assert {"infer_ms", "prev_total_ms"} == set(second["server_timing"])
        assert "beside an observation" in ask(client, {**observation(1), MARK: {"end": True}})
        end = ask(client, {MARK: {"end": True, "facts": {"success": True}}})
        assert end["actions"].shape == (0, first["actions"].shape[1])
    run = server.close()
    assert run is not None
    assert run.episodes[["episode_id", "client", "outcome"]].to_numpy().tolist() == [["a", "arm-1", "success"]]


@pytest.mark.slow
def test_a_client_is_greeted_while_the_model_infers_for_one_that_vanishes(
    opened: Opens, policy: Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, predict, begun = opened(captured_calls=1), type(policy).predict, threading.Event()

    def slow(self: Policy, observations: Any, seeds: Any) -> Any:
        begun.set()
        time.sleep(1.5)
        return predict(self, observations, seeds)

    monkeypatch.setattr(type(policy), "predict", slow)
    with serving(server) as address, connect(address) as first:
        first.recv(PATIENCE)
        first.send(pack({**observation(0), MARK: {"id": "a"}}))
        assert begun.wait(PATIENCE)
        began = time.monotonic()
        with connect(address) as second:
            second.recv(PATIENCE)
            assert time.monotonic() - began < 1
            first.close_socket()
            assert "actions" in ask(second, {**observation(1), MARK: {"id": "b"}})
    run = server.close()
    assert run is not None
    assert sorted(run.episodes["episode_id"]) == ["a", "b"]


def oversized(client: ClientConnection) -> None:
    client.send(bytes((16 << 20) + 1))


def unreadable(client: ClientConnection) -> None:
    client.send(b"\xc1")


def text(client: ClientConnection) -> None:
    client.send("hello")


@pytest.mark.parametrize(
    ("send", "code"),
    [
        pytest.param(unreadable, 1007, marks=pytest.mark.slow),
        pytest.param(oversized, 1009, marks=pytest.mark.slow),
        pytest.param(text, 1007, marks=pytest.mark.slow),
    ],
)
def test_a_message_that_cannot_be_read_closes_its_own_connection(
    opened: Opens, send: Callable[[ClientConnection], None], code: int
) -> None:
    server = opened()
    with serving(server) as address, connect(address, max_size=None) as client:
        client.recv(PATIENCE)
        send(client)
        with pytest.raises(ConnectionClosedError) as closed:
            client.recv(PATIENCE)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == code
        with connect(address) as other:
            assert unpack(other.recv(PATIENCE))
    assert server.close() is None


def test_only_a_client_with_the_token_is_served_and_no_browser(opened: Opens) -> None:
    server = opened(token="secret-1")
    with serving(server) as address:
        for headers in ({}, {"Authorization": "Api-Key secret-2"}, {"Authorization": "secret-1"}):
            with pytest.raises(InvalidStatus, match="401"):
                connect(address, additional_headers=headers)
        with pytest.raises(InvalidStatus, match="403"):
            connect(address, origin="http://localhost:1", additional_headers={"Authorization": "Api-Key secret-1"})  # type: ignore[arg-type]
        with connect(address, additional_headers={"Authorization": "Api-Key secret-1"}) as client:
            assert unpack(client.recv(PATIENCE))
        split = urlsplit(address)
        question = http.client.HTTPConnection(str(split.hostname), split.port, timeout=20)
        question.request("GET", "/healthz")
        assert question.getresponse().read() == b"OK\n"
        question.close()
    server.close()


@pytest.mark.slow
def test_changed_requests_cost_a_line_each_and_neither_memory_nor_threads_grow(opened: Opens) -> None:
    server, rng = opened(captured_calls=1), np.random.default_rng(0)
    request = pack({**observation(0, side=8), MARK: {"id": "a"}})
    lines, codes, threads, memory = list[str](), list[int | None](), list[int](), list[int]()
    with serving(server) as address, ExitStack() as connections:
        client = connections.enter_context(connect(address, compression=None))
        client.recv(PATIENCE)
        client.send(request)
        assert not isinstance(client.recv(PATIENCE), str)
        for _ in range(200):
            content = bytearray(request)
            for at in rng.integers(0, len(content), 4):
                content[at] = rng.integers(0, 256)
            try:
                client.send(bytes(content))
                answer = client.recv(PATIENCE)
                lines += [answer] if isinstance(answer, str) else []
            except ConnectionClosed as error:
                codes.append(error.rcvd and error.rcvd.code)
                lines.append(error.rcvd.reason if error.rcvd else "")
                client = connections.enter_context(connect(address, compression=None))
                client.recv(PATIENCE)
            # asyncio's own pool grows to its bound, as it is used.
            threads.append(sum(not thread.name.startswith("asyncio_") for thread in threading.enumerate()))
            memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        client.send(pack({**observation(0, side=8), MARK: {"id": "last"}}))
        assert not isinstance(client.recv(PATIENCE), str)
    assert set(codes) == {1007}
    assert len(codes) < len(lines) < 200, "some are refused, some close their connection, and some are answered"
    assert all(len(line.splitlines()) == 1 and "Traceback" not in line for line in lines)
    # A connection that closes has its threads for a moment longer.
    assert min(threads[-20:]) <= max(threads[:50])
    assert memory[-1] - memory[49] < 64 * 1024, "kibibytes"
    server.close()
