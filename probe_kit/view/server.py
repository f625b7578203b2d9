"""The viewer's server: loopback only, behind a token, and names are looked up and never joined to a path.

Five parts of a request are checked in order: the Host header, the method, the token, the site of the request with
the cookie, and the name of the payload. A Host header with another name of this machine may be a rebound one.
"""

import asyncio
import hashlib
import json
import os
import re
import secrets
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock, Thread
from typing import Any
from urllib.parse import parse_qs

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from probe_kit.errors import ProbeKitError, UsageError
from probe_kit.view.catalogue import INDEX_PAYLOAD, Catalogue
from probe_kit.view.export import INDEX, page_files

HOST = "127.0.0.1"
TICK_S = 2.0
"""Seconds between two listings of the commits of a run that grows: a listing of a bucket is a request."""
_GZIP_FROM = 2000
"""Size in bytes of an answer from which it is compressed: less fits into two packets either way."""
_MOST_HEADER_BYTES = 1 << 20
"""Largest number of bytes of a request's header.

A browser sends the cookies of every other server of 127.0.0.1 too, at most 180 of 4 KB.
"""
_LEADING_TO = '<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="0; url={address}">\n'
_ICON = "/favicon.ico"
_PICTURE = re.compile(r"([A-Za-z0-9._-]+)/f/([0-9]{5,8})\.webp")
_KINDS = {"css": "text/css", "html": "text/html", "js": "text/javascript", "svg": "image/svg+xml"}
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
_HEADERS = {
    "content-security-policy": _POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
}


class _Guard:
    """Admits the requests of the page that was opened with the token, and no other."""

    def __init__(self, app: ASGIApp, port: int, token: str) -> None:
        self._app, self._token = app, token
        self._hosts = {f"{HOST}:{port}", f"localhost:{port}"}
        self._cookie, self._pass = f"probe_kit_view_{port}", secrets.token_urlsafe(32)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return await self._app(scope, receive, send)

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = [(name.encode(), value.encode()) for name, value in _HEADERS.items()]
                message = {**message, "headers": [*message["headers"], *headers]}
            await send(message)

        answer = self._answer(Request(scope)) or self._app
        return await answer(scope, receive, send_guarded)

    def _answer(self, request: Request) -> Response | None:
        """Return a refusal, or the way from the token to the page; None for a request that is admitted."""
        if request.headers.get("host") not in self._hosts:
            return PlainTextResponse("unknown host", 400)
        if request.method not in ("GET", "HEAD"):
            return PlainTextResponse("refused", 403)
        token = parse_qs(request.url.query).get("token", [""])[0]
        if token and _are_equal(token, self._token):
            # A page of this server, not a redirect: a browser that comes from a file sends a strict cookie only
            # with requests that this page makes.
            response = HTMLResponse(_LEADING_TO.format(address="/"))
            response.set_cookie(self._cookie, self._pass, httponly=True, samesite="strict")
            return response
        if request.headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return PlainTextResponse("refused", 403)
        if request.url.path == _ICON:  # a browser asks for it before the page has its cookie
            return None
        if not any(_are_equal(value, self._pass) for value in _cookies(request, self._cookie)):
            return PlainTextResponse("Open the address that `probe-kit view` printed.", 403)
        return None


def _are_equal(text: str, secret: str) -> bool:
    return secrets.compare_digest(text.encode(), secret.encode())


def _cookies(request: Request, name: str) -> list[str]:
    """Return the values of all cookies of a name.

    Cookies of other servers of 127.0.0.1 come with ours, in any form, so only the text around `;` and `=` is read.
    """
    pairs = (pair.partition("=") for line in request.headers.getlist("cookie") for pair in line.split(";"))
    return [value.strip() for key, _, value in pairs if key.strip() == name]


class _Pages:
    """The endpoints. One thread at a time uses the catalogue, except for the index, which needs no table."""

    def __init__(self, catalogue: Catalogue, tick_s: float) -> None:
        self._catalogue, self._tick_s, self._lock = catalogue, tick_s, Lock()
        self._session = secrets.token_hex(8)
        self._files = page_files()

    def file(self, request: Request) -> Response:
        """Return the page, a file of it, or the picture in the tab of the page that leads to it."""
        names = {"/": INDEX, _ICON: "app/icon.svg"}
        name = names.get(request.url.path) or f"app/{request.path_params['name']}"
        content = self._files.get(name)
        if content is None:
            return _missing()
        kind = _KINDS.get(name.rpartition(".")[2], "text/plain")
        return _tag_response(request, content, hashlib.sha256(content).hexdigest(), kind)

    def data(self, request: Request) -> Response:
        """Return a payload or a picture."""
        name = str(request.path_params["name"])
        if name == f"{INDEX_PAYLOAD}.js":
            return self._payload(request, INDEX_PAYLOAD)
        try:
            with self._lock:
                if match := _PICTURE.fullmatch(name):
                    picture = self._catalogue.picture(match[1], int(match[2]))
                    if picture is None:
                        return _missing()
                    return _tag_response(request, picture, hashlib.sha256(picture).hexdigest(), "image/webp")
                payload = name.removesuffix(".js")
                if payload == name:
                    return _missing()
                return self._payload(request, payload)
        except KeyError:
            return _missing()
        except (ProbeKitError, OSError) as error:
            return PlainTextResponse(str(error), 500)

    def _payload(self, request: Request, name: str) -> Response:
        """Return the payload, or a script with the reason why it cannot be made.

        The page cannot read the text of an error.
        """
        # Of this server alone: behind the same port, a later one may have other runs, interventions or labels.
        tag = f"{self._session}-{self._catalogue.stamp(name)}"
        is_current = request.headers.get("if-none-match") == f'"{tag}"'
        try:
            script = b"" if is_current else self._catalogue.script(name)
        except (ProbeKitError, OSError) as error:
            script = self._catalogue.failure(name, error)
            return Response(script, headers={"cache-control": "no-store"}, media_type=_KINDS["js"])
        return _tag_response(request, script, tag, _KINDS["js"])

    def prepare(self) -> None:
        """Compute the tables of the runs, while the browser that will ask for them starts."""
        for key in list(self._catalogue.runs):
            with self._lock, suppress(ProbeKitError):  # the page asks again, and shows the error
                _ = self._catalogue.stamp(f"{key}/run"), self._catalogue.runs[key].table

    async def follow(self, request: Request) -> Response:
        """Return events of runs that grow, with their committed episodes; nothing where every run is finished."""
        if not self._catalogue.growing:
            return Response(status_code=204)
        return StreamingResponse(self._events(request), media_type="text/event-stream")

    async def _events(self, request: Request) -> AsyncIterator[str]:
        sent: dict[str, dict[str, Any]] = {}
        yield ": following\n\n"
        while not await request.is_disconnected():
            for growth in await run_in_threadpool(self._poll):
                if sent.get(growth["run"]) != growth:
                    sent[growth["run"]] = growth
                    yield f"data: {json.dumps(growth)}\n\n"
            await asyncio.sleep(self._tick_s)

    def _poll(self) -> list[dict[str, Any]]:
        with self._lock:
            return self._catalogue.poll()


def _missing() -> Response:
    return PlainTextResponse("there is no such page", 404)


def _tag_response(request: Request, content: bytes, tag: str, kind: str) -> Response:
    """Return the content with its tag, or nothing where the browser has it."""
    headers = {"etag": f'"{tag}"', "cache-control": "no-cache"}
    if request.headers.get("if-none-match") == headers["etag"]:
        return Response(status_code=304, headers=headers)
    return Response(content, headers=headers, media_type=kind)


def _application(pages: _Pages, port: int, token: str) -> Starlette:
    """Return the application that serves the pages at `127.0.0.1:port` to a browser with the token."""
    return Starlette(
        routes=[
            Route("/", pages.file),
            Route("/app/{name}", pages.file),
            Route(_ICON, pages.file),
            Route("/data/{name:path}", pages.data),
            Route("/follow", pages.follow),
        ],
        middleware=[
            Middleware(_Guard, port=port, token=token),
            Middleware(GZipMiddleware, minimum_size=_GZIP_FROM),
        ],
    )


def _open_port(port: int) -> socket.socket:
    """Return an open socket at a port of the loopback address."""
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, port))
        listener.listen()
    except OSError as error:
        listener.close()
        raise UsageError(f"port {port} of {HOST}: {error.strerror}. Give another one, or none") from error
    return listener


class ViewerServer:
    """A server on loopback whose socket is open from the first moment.

    Args:
        catalogue: The payloads that it serves.
        port: Port of the loopback address; 0 for any free one.

    Raises:
        UsageError: If the port cannot be opened, for example because it is in use.
    """

    def __init__(self, catalogue: Catalogue, port: int = 0) -> None:
        self._socket = _open_port(port)
        self.port: int = self._socket.getsockname()[1]
        self._token = secrets.token_urlsafe(16)
        self._pages = _Pages(catalogue, TICK_S)
        app = _application(self._pages, self.port, self._token)
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                log_level="error",
                timeout_graceful_shutdown=1,
                http="h11",
                h11_max_incomplete_event_size=_MOST_HEADER_BYTES,
            )
        )

    @property
    def address(self) -> str:
        """The address that opens the page."""
        return f"http://{HOST}:{self.port}/?token={self._token}"

    @contextmanager
    def private_file(self) -> Iterator[Path]:
        """Yield a file that leads a browser to `address`, which only this user can read; removed afterwards.

        A command line can be read by every user of a machine, and an address on it would let them in.
        """
        with TemporaryDirectory(prefix="probe-kit-view-") as folder:
            file = Path(folder) / "open.html"
            with os.fdopen(
                os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8"
            ) as page:
                page.write(_LEADING_TO.format(address=self.address))
            yield file

    def run(self) -> None:
        """Serve until interrupted, or until `stop`."""
        Thread(target=self._pages.prepare, daemon=True).start()
        self._server.run(sockets=[self._socket])

    def stop(self) -> None:
        """End `run`."""
        self._server.should_exit = True
