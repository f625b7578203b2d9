"""An S3 server of our own on a port of this machine: moto's, started by the tests that need one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Thread
from typing import Any
from urllib.request import Request, urlopen

import pytest

BUCKET = "probe-kit-tests"


@contextmanager
def _s3_server(patch: pytest.MonkeyPatch, conditional: bool) -> Iterator[str]:
    """The URL of an empty bucket, which the environment then leads to.

    conditional: whether the server honours If-None-Match; some stores that speak S3 do not.
    """
    server = pytest.importorskip("moto.server", reason="moto is not installed")
    pytest.importorskip("obstore", reason="obstore is not installed (extra `remote`)")
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log_request(self, *_: object) -> None:
            """Say nothing of requests."""

    app = server.DomainDispatcherApplication(server.create_backend_app)
    listening = make_server(
        "127.0.0.1", 0, app if conditional else _without_conditions(app), threaded=True, request_handler=Quiet
    )
    thread = Thread(target=listening.serve_forever)
    thread.start()
    environment = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{listening.port}",
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing",
        "AWS_REGION": "us-east-1",
        "AWS_ALLOW_HTTP": "true",
    }
    for name, value in environment.items():
        patch.setenv(name, value)
    try:
        _ask(f"{environment['AWS_ENDPOINT_URL']}/moto-api/reset", "POST")
        _ask(f"{environment['AWS_ENDPOINT_URL']}/{BUCKET}", "PUT")
        yield f"s3://{BUCKET}"
    finally:
        listening.shutdown()
        thread.join()
        listening.server_close()


def _ask(url: str, method: str) -> None:
    headers = {"Authorization": "AWS4-HMAC-SHA256 Credential=nobody/20260101/us-east-1/s3/aws4_request"}
    urlopen(Request(url, method=method, headers=headers)).close()


def _without_conditions(app: Callable[..., Any]) -> Callable[..., Any]:
    """The same server, deaf to If-None-Match."""

    def deaf(environ: dict[str, Any], start_response: Callable[..., Any]) -> Any:
        environ.pop("HTTP_IF_NONE_MATCH", None)
        return app(environ, start_response)

    return deaf


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """URL of an empty bucket on a server that does what S3 does."""
    with _s3_server(monkeypatch, conditional=True) as url:
        yield url


@pytest.fixture
def deaf_bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """URL of an empty bucket on a server that ignores If-None-Match."""
    with _s3_server(monkeypatch, conditional=False) as url:
        yield url
