"""An S3 server of our own on a port of this machine: moto's, which can be stopped and made to fail.

As a program it prints its address and ends with its standard input, see `server_elsewhere`.
"""

import json
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from threading import Event, Thread
from typing import Any, NamedTuple, NoReturn
from urllib.parse import unquote
from urllib.request import Request, urlopen

import pytest

BUCKET = "probe-kit-tests"
App = Callable[..., Iterable[bytes]]


class S3Server:
    """Moto's server. What it holds stays while it is stopped.

    wrap: what stands between it and its clients.
    """

    def __init__(self, wrap: Callable[[App], App] = lambda app: app) -> None:
        server = pytest.importorskip("moto.server", reason="moto is not installed")
        pytest.importorskip("obstore", reason="obstore is not installed (extra `remote`)")
        self._app = wrap(server.DomainDispatcherApplication(server.create_backend_app))
        self._port = 0
        self.start()

    def start(self) -> None:
        """Start the server, on its former port."""
        from werkzeug.serving import WSGIRequestHandler, make_server

        class Quiet(WSGIRequestHandler):
            def log_request(self, *_: object) -> None:
                """Log no request."""

            def log(self, *_: object) -> None:
                """Nor of clients that are gone."""

        self._server = make_server("127.0.0.1", self._port, self._app, threaded=True, request_handler=Quiet)
        self._port = self._server.port
        self._thread = Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.02})
        self._thread.start()

    def stop(self) -> None:
        """Stop the server; its port answers no more."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    @property
    def environment(self) -> dict[str, str]:
        """What leads a client here."""
        return {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self._port}",
            "AWS_ACCESS_KEY_ID": "nobody",
            "AWS_SECRET_ACCESS_KEY": "nothing",
            "AWS_REGION": "us-east-1",
            "AWS_ALLOW_HTTP": "true",
        }

    def empty(self) -> str:
        """Forget everything; the URL of a new bucket."""
        return empty_bucket(self.environment)


def empty_bucket(environment: dict[str, str]) -> str:
    """Make the server to which this leads forget everything; the URL of a new bucket there."""
    headers = {
        "Authorization": "AWS4-HMAC-SHA256 Credential=nobody/20260101/us-east-1/s3/aws4_request",
        "X-Trusted": "yes",
    }
    for path, method in (("moto-api/reset", "POST"), (BUCKET, "PUT")):
        urlopen(Request(f"{environment['AWS_ENDPOINT_URL']}/{path}", method=method, headers=headers)).close()
    return f"s3://{BUCKET}"


@contextmanager
def server_elsewhere() -> Iterator[dict[str, str]]:
    """A server in a process of its own, and what leads a client there."""
    pytest.importorskip("moto.server", reason="moto is not installed")
    pytest.importorskip("obstore", reason="obstore is not installed (extra `remote`)")
    command = [sys.executable, str(Path(__file__))]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8") as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())
        finally:
            process.stdin.close()


def without_conditions(app: App) -> App:
    """The same server, deaf to If-None-Match."""

    def deaf(environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        environ.pop("HTTP_IF_NONE_MATCH", None)
        return app(environ, start_response)

    return deaf


class Call(NamedTuple):
    """A request as a client means it.

    call: one of `CALLS`. key: of the object, without the bucket; of a listing or bulk deletion empty.
    """

    call: str
    key: str

    @classmethod
    def of(cls, environ: dict[str, Any]) -> "Call":
        method, query = environ["REQUEST_METHOD"], environ.get("QUERY_STRING", "")
        # What the client sent: decoded paths have no %20 and no question mark.
        key = unquote(environ["REQUEST_URI"].partition("?")[0]).removeprefix(f"/{BUCKET}").lstrip("/")
        if method == "PUT":
            conditional = "HTTP_IF_NONE_MATCH" in environ
            return cls("part" if "partNumber" in query else "create" if conditional else "put", key)
        if method == "POST":
            return cls("delete" if not key else "complete" if "uploadId" in query else "begin", key)
        if method == "GET":
            return cls("list" if not key else "get", key)
        return cls("abort" if method == "DELETE" else method.lower(), key)


CALLS = ("put", "create", "begin", "part", "complete", "get", "head", "list", "delete")
ANSWERS = ("conflict", "failed", "hurried", "broken", "busy", "unanswered", "cut")
"""What `Unreliable` does to a request: 409, 412, 429, 500, 503, done and no reply, done and half a reply."""


class Unreliable:
    """The same server on a bad day: `ail` says of every request what happens to it, None for nothing.

    Every other answer is the name of a method here. seen: how often each happened. attack: the same as `ail`, of
    the call that the client made.
    """

    def __init__(self, app: App) -> None:
        self._app = app
        self.ail: Callable[[str, str], str | None] = lambda _method, _path: None
        self.attack: Callable[[Call], str | None] = lambda _call: None
        self.seen: Counter[str] = Counter()
        self.over = Event()

    def __call__(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        trusted = "HTTP_X_TRUSTED" in environ
        ill = None if trusted else self.ail(environ["REQUEST_METHOD"], environ["PATH_INFO"])
        ill = ill or (None if trusted else self.attack(Call.of(environ)))
        if ill is None:
            return self._app(environ, start_response)
        self.seen[ill] += 1
        answer: Iterable[bytes] = getattr(self, ill)(environ, start_response)
        return answer

    def busy(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        """It asks to slow down."""
        return _refuse(environ, start_response, "503 Slow Down", "SlowDown")

    def conflict(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        """Another request for the same key is under way."""
        return _refuse(environ, start_response, "409 Conflict", "OperationAborted")

    def failed(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        """A condition does not hold, whether or not there was one."""
        return _refuse(environ, start_response, "412 Precondition Failed", "PreconditionFailed")

    def hurried(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        """There were too many requests."""
        return _refuse(environ, start_response, "429 Too Many Requests", "TooManyRequests")

    def broken(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        """It made a mistake of its own."""
        return _refuse(environ, start_response, "500 Internal Server Error", "InternalError")

    def torn(self, environ: dict[str, Any], _start_response: Callable[..., Any]) -> Iterable[bytes]:
        """It is gone when half of an upload has arrived, and keeps nothing."""
        environ["wsgi.input"].read(_length(environ) // 2)
        return _hang_up(environ)

    def unanswered(self, environ: dict[str, Any], _start_response: Callable[..., Any]) -> Iterable[bytes]:
        """It does what it was asked, and is gone before it says so."""
        list(self._app(environ, lambda *_: None))
        return _hang_up(environ)

    def cut(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        """Its answer ends in the middle."""
        content = b"".join(self._app(environ, start_response))
        yield content[: len(content) // 2]
        _hang_up(environ)

    def slow(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        """It answers late."""
        time.sleep(0.1)
        return self._app(environ, start_response)

    def silent(self, environ: dict[str, Any], _start_response: Callable[..., Any]) -> Iterable[bytes]:
        """Accepts the request and does not answer until the end."""
        self.over.wait()
        return _hang_up(environ)


class BadServer(S3Server):
    """A server whose days are bad at will. url: of its bucket."""

    day: Unreliable
    url: str

    def __init__(self) -> None:
        super().__init__(self._wrapped)

    def _wrapped(self, app: App) -> App:
        self.day = Unreliable(app)
        return self.day


def _length(environ: dict[str, Any]) -> int:
    return int(environ.get("CONTENT_LENGTH") or 0)


def _refuse(
    environ: dict[str, Any], start_response: Callable[..., Any], status: str, code: str
) -> Iterable[bytes]:
    environ["wsgi.input"].read(_length(environ))
    start_response(status, [("Content-Type", "application/xml")])
    return [f"<Error><Code>{code}</Code><Message>Try again.</Message></Error>".encode()]


def _hang_up(environ: dict[str, Any]) -> NoReturn:
    environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
    raise ConnectionResetError  # werkzeug then answers nothing


def now_and_then(ills: Iterable[str], share: float, seed: int) -> Callable[[str, str], str | None]:
    """This share of all requests has one of these, drawn at random."""
    draw, choices = Random(seed), list(ills)
    return lambda _method, _path: draw.choice(choices) if draw.random() < share else None


if __name__ == "__main__":
    served = S3Server()
    print(json.dumps(served.environment), flush=True)
    sys.stdin.read()
    served.stop()
