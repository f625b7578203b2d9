"""A server of a wire: its socket, the clients that it admits, and the thread on which the session is called."""

import asyncio
import logging
import re
import secrets
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from typing import Any, ClassVar

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from probe_kit._system.escaping import terminal_safe, without_folders
from probe_kit.errors import ProbeKitError
from probe_kit.serve.codec import MOST_BYTES
from probe_kit.serve.marks import LONGEST
from probe_kit.serve.session import Client, Session

MOST_CLIENTS = 64
HEALTH = ("/healthz", "/health")
BAD_DATA = 1007
"""The code with which a connection is closed whose message cannot be read."""
_FAULTS = (1002, BAD_DATA, 1009)
"""The codes of connections that we close because of what a client sent."""
_LONGEST_ANSWER = 2000
"""The most characters of an error's text on the wire."""
_NAME = re.compile(rf"/[A-Za-z0-9._@-]{{1,{LONGEST}}}")
_SCHEME = "Api-Key "


@dataclass
class WireServer(ABC):
    """A server of one session on a websocket, of any wire.

    Attributes:
        session: The session; its methods are called on one thread.
        listener: The bound socket.
        token: The token that clients send; empty where none is needed.
        metadata: What the first frame holds beside our own entry, on a wire that has one.
        stop: Called when the session ends the server by itself.
        note: Called with a line about a connection that was closed.
        keep_alive: The seconds between pings to a client; None for a wire that has none.
    """

    session: Session
    listener: socket.socket
    token: str = ""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    stop: Callable[[], None] = lambda: None
    note: Callable[[str], None] = lambda _: None
    keep_alive: ClassVar[float | None] = 20.0

    def __post_init__(self) -> None:
        self.thread = ThreadPoolExecutor(1, "probe-kit-model")
        """The thread of the model, on which the session is called."""
        self.busy = 0
        """The number of requests that are being answered."""
        self.ends = False
        """Whether no further request is answered."""
        self._open = 0

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
            ping_interval=self.keep_alive,
            ping_timeout=None,  # an inference may take longer
            logger=quiet,
            server_header=None,
        )

    async def drain(self) -> None:
        """Let every open request be answered, and no further one."""
        self.ends = True
        while self.busy:
            await asyncio.sleep(0.02)

    async def close(self) -> None:
        """Wait until the thread of the model has nothing left to do."""
        await asyncio.get_running_loop().run_in_executor(None, partial(self.thread.shutdown, wait=True))

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return a refusal, or the answer to a question about health; None for a client that is admitted."""
        if request.path in HEALTH:
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

    async def on_model_thread[Result](self, work: Callable[..., Result], *arguments: Any) -> Result:
        """Return the result of a function that is called on the thread of the model."""
        return await asyncio.get_running_loop().run_in_executor(self.thread, work, *arguments)

    async def _handle(self, connection: ServerConnection) -> None:
        self._open += 1
        assert connection.request is not None, "it was admitted by its request"
        name = connection.request.path.removeprefix("/")
        client = self.session.connect(name)  # here: a client is greeted while the model infers for another
        try:
            await self._converse(connection, client)
        except ConnectionClosed:
            pass
        finally:
            self._open -= 1
            if (closed := connection.protocol.close_sent) is not None and closed.code in _FAULTS:
                self.note(f"{client.name} was closed with {closed.code}: {closed.reason}")
            try:
                await self.on_model_thread(self.session.leave, client)
            except Exception:  # noqa: BLE001 - the session has it as `fatal`
                self.stop()

    @abstractmethod
    async def _converse(self, connection: ServerConnection, client: Client) -> None:
        """Answer a client until it leaves."""

    async def finish_check(self) -> None:
        """Prove what the first answer leaves to be proved, once it is sent; a later request waits for it."""
        await self.on_model_thread(self.session.finish_check)
        self.stop_if_fatal()

    def stop_if_fatal(self) -> None:
        """End the server if the session says so."""
        if self.session.fatal is not None:
            self.stop()


def one_line(error: BaseException) -> str:
    """Return an error as one line for a client: no traceback, and no folder of this machine."""
    return f"{type(error).__name__}: {text_of(error)}"[:_LONGEST_ANSWER]


def text_of(error: BaseException) -> str:
    """Return the text of an error as `one_line` has it, without the error's name."""
    text = (
        " ".join(str(error).split()) if isinstance(error, ProbeKitError) else "an internal error; see the server"
    )
    return terminal_safe(without_folders(text))[:_LONGEST_ANSWER]
