"""The wire of openpi: a websocket on which an observation and an answer follow each other."""

import asyncio
import logging
import re
import secrets
import socket
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from time import monotonic, perf_counter
from typing import Any

import numpy as np
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from probe_kit._system.escaping import terminal_safe, without_folders
from probe_kit.errors import ProbeKitError, UsageError
from probe_kit.serve.codec import MOST_BYTES, MessageError, pack, unpack
from probe_kit.serve.marks import KEY, LONGEST, read_mark
from probe_kit.serve.session import Client, Session
from probe_kit.version import __version__

MOST_CLIENTS = 64
HEALTH = "/healthz"
_BAD_DATA = 1007
"""The code with which a connection is closed whose message cannot be read."""
_FAULTS = (1002, _BAD_DATA, 1009)
"""The codes of connections that we close because of what a client sent."""
_LONGEST_ANSWER = 2000
"""The most characters of an error's text on the wire."""
_NAME = re.compile(rf"/[A-Za-z0-9._@-]{{1,{LONGEST}}}")
_SCHEME = "Api-Key "


@dataclass
class OpenpiServer:
    """A server of openpi's wire, of one session.

    Attributes:
        session: The session; its methods are called on one thread.
        listener: The bound socket.
        token: The token that clients send; empty where none is needed.
        metadata: What the first frame holds beside our own entry.
        stop: Called when the session ends the server by itself.
        note: Called with a line about a connection that was closed.
    """

    session: Session
    listener: socket.socket
    token: str = ""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    stop: Callable[[], None] = lambda: None
    note: Callable[[str], None] = lambda _: None

    def __post_init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "probe-kit-model")
        self._open = self._busy = 0
        self._ends = False

    async def start(self) -> Server:
        """Open the socket for clients, and return the server."""
        quiet = logging.getLogger("probe_kit.serve")
        quiet.propagate, quiet.disabled = False, True  # its tracebacks are of clients that vanish
        return await serve(
            self._handle,
            sock=self.listener,
            process_request=self._admit,
            compression=None,
            max_size=MOST_BYTES,
            ping_timeout=None,  # an inference may take longer
            logger=quiet,
            server_header=None,
        )

    async def drain(self) -> None:
        """Let every open request be answered, and no further one."""
        self._ends = True
        while self._busy:
            await asyncio.sleep(0.02)

    async def close(self) -> None:
        """Wait until the thread of the model has nothing left to do."""
        await asyncio.get_running_loop().run_in_executor(None, partial(self._thread.shutdown, wait=True))

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return a refusal, or the answer to a question about health; None for a client that is admitted."""
        if request.path == HEALTH:
            return connection.respond(HTTPStatus.OK, "OK\n")
        if "Origin" in request.headers:
            return connection.respond(HTTPStatus.FORBIDDEN, "no browser is served\n")
        sent = request.headers.get("Authorization", "")
        if self.token and not secrets.compare_digest(sent.encode(), f"{_SCHEME}{self.token}".encode()):
            self.note("refused: a client without the token")
            return connection.respond(HTTPStatus.UNAUTHORIZED, "the token is missing or wrong\n")
        if request.path != "/" and not _NAME.fullmatch(request.path):
            return connection.respond(HTTPStatus.BAD_REQUEST, "the path names the client: letters and digits\n")
        if self._open >= MOST_CLIENTS:
            return connection.respond(
                HTTPStatus.SERVICE_UNAVAILABLE, f"there are {MOST_CLIENTS} clients already\n"
            )
        return None

    async def _run[Result](self, work: Callable[..., Result], *arguments: Any) -> Result:
        """Return the result of a function that is called on the thread of the model."""
        return await asyncio.get_running_loop().run_in_executor(self._thread, work, *arguments)

    async def _handle(self, connection: ServerConnection) -> None:
        self._open += 1
        assert connection.request is not None, "it was admitted by its request"
        name = connection.request.path.removeprefix("/")
        client = self.session.connect(name)  # here: a client is greeted while the model infers for another
        try:
            await connection.send(pack({**self.metadata, "probe_kit": {"version": __version__, "mark": KEY}}))
            await self._converse(connection, client)
        except ConnectionClosed as closed:
            if closed.sent is not None and closed.sent.code in _FAULTS:
                self.note(f"{client.name} was closed with {closed.sent.code}: {closed.sent.reason}")
        finally:
            self._open -= 1
            try:
                await self._run(self.session.leave, client)
            except Exception:  # noqa: BLE001 - the session has it as `fatal`
                self.stop()

    async def _converse(self, connection: ServerConnection, client: Client) -> None:
        took = 0.0
        async for message in connection:
            if self._ends:
                return
            began = perf_counter()
            self._busy += 1
            try:
                answer = await self._answer(client, message)
            except MessageError as error:
                await connection.close(_BAD_DATA, _one_line(error)[:120])
                self.note(f"{client.name} sent a message that cannot be read: {error}")
                return
            except Exception as error:  # noqa: BLE001 - a bug costs its request, and ends the server by its name
                await connection.send(_one_line(error))
                if self.session.fatal is not None:
                    self.stop()
                continue
            else:
                if took:
                    answer["server_timing"]["prev_total_ms"] = took
                await connection.send(pack(answer))
            finally:
                self._busy -= 1
            took = 1000 * (perf_counter() - began)
            # What the first answer leaves to be proved; a later request waits for it.
            await self._run(self.session.finish_check)
            if self.session.fatal is not None:
                self.stop()

    async def _answer(self, client: Client, message: str | bytes) -> dict[str, Any]:
        if isinstance(message, str):
            raise MessageError("the message is a text; expected a binary frame of msgpack")
        sent = unpack(message)
        mark = read_mark(sent.pop(KEY)) if KEY in sent else None
        began = perf_counter()
        if mark is not None and mark.end:
            if sent:
                raise UsageError(f"{KEY} says an end beside an observation; send the end alone")
            await self._run(self.session.end, client, mark)
            actions = np.zeros((0, *self.session.width), np.float32)
        else:
            actions = await self._run(self.session.answer, client, sent, mark, monotonic())
        return {"actions": actions, "server_timing": {"infer_ms": 1000 * (perf_counter() - began)}}


def _one_line(error: BaseException) -> str:
    """Return an error as one line for a client: no traceback, and no folder of this machine."""
    name = type(error).__name__
    text = (
        " ".join(str(error).split()) if isinstance(error, ProbeKitError) else "an internal error; see the server"
    )
    return terminal_safe(without_folders(f"{name}: {text}"))[:_LONGEST_ANSWER]
