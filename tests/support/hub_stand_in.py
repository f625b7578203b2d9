"""A local server that answers as the hub does when a data set is uploaded, and records what it gets."""

import base64
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any

_PULL_REQUEST = {
    "num": 1, "title": "study", "createdAt": "2026-01-01T00:00:00.000Z", "status": "draft", "events": [],
    "isPullRequest": True, "changes": {"base": "refs/heads/main"}, "filesWithConflicts": [],
    "repo": {"name": "lab/study", "type": "dataset"},
}  # fmt: skip


@dataclass
class Hub:
    """failures: first answers to commits, a status or 0 for a cut connection. files: of commits, by path."""

    failures: list[int] = field(default_factory=list)
    requests: list[tuple[str, str, str]] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)
    commits: int = 0
    address: str = ""

    def answer(self, path: str, body: bytes) -> Any:
        """What the hub says to a request."""
        if "/preupload/" in path:
            asked = json.loads(body)["files"]
            found = [{"path": one["path"], "uploadMode": "regular", "shouldIgnore": False} for one in asked]
            return {"files": found}
        if "/commit/" in path:
            return self._commit(body)
        if "/discussions" in path:
            return _PULL_REQUEST
        if path == "/api/repos/create":
            return {"url": f"{self.address}/datasets/lab/study", "id": "1"}
        return {"errors": [], "warnings": []}

    def _commit(self, body: bytes) -> Any:
        for line in body.decode().splitlines():
            part = json.loads(line)
            if part["key"] == "file":
                self.files[part["value"]["path"]] = base64.b64decode(part["value"]["content"])
        self.commits += 1
        home = f"{self.address}/datasets/lab/study"
        return {
            "commitUrl": f"{home}/commit/{self.commits:040d}",
            "commitOid": f"{self.commits:040d}",
        }


@contextmanager
def hub() -> Iterator[Hub]:
    """A hub at `address` as long as the body runs."""
    found = Hub()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length") or 0))
            token = str(self.headers.get("authorization"))
            found.requests.append((self.command, self.path, token))
            status = 200
            if found.failures and "/commit/" in self.path:
                status = found.failures.pop(0)
            if status == 0:
                self.close_connection = True
                self.connection.close()
                return
            content = json.dumps(found.answer(self.path, body) if status == 200 else {"error": "no"}).encode()
            self.send_response(status)
            self.send_header("content-type", "application/json")
            self.send_header("content-length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def do_GET(self) -> None:
            self.do_POST()

        def log_message(self, *_: object) -> None:
            """Nothing is printed."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    found.address = f"http://127.0.0.1:{server.server_port}"
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield found
    finally:
        server.shutdown()
        server.server_close()
