"""A local server that answers as the hub does to uploads and downloads, and records what it gets."""

import base64
import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any
from urllib.parse import unquote

_PULL_REQUEST = {
    "num": 1, "title": "study", "createdAt": "2026-01-01T00:00:00.000Z", "status": "draft", "events": [],
    "isPullRequest": True, "changes": {"base": "refs/heads/main"}, "filesWithConflicts": [],
    "repo": {"name": "lab/study", "type": "dataset"},
}  # fmt: skip
_API = ("/api/models/", "/api/datasets/")


@dataclass
class Hub:
    """failures: first answers to commits, a status or 0 for a cut connection. files: of commits, by path.

    models: files of commits of a model or a data set, by repository and commit. names: commits of branches and
    tags. refusals: of a repository, the status and the code of an error.
    """

    failures: list[int] = field(default_factory=list)
    requests: list[tuple[str, str, str]] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)
    commits: int = 0
    address: str = ""
    models: dict[str, dict[str, dict[str, bytes]]] = field(default_factory=dict)
    names: dict[str, dict[str, str]] = field(default_factory=dict)
    refusals: dict[str, tuple[int, str]] = field(default_factory=dict)

    def download(self, path: str) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body of what is asked of a model or a data set."""
        api = path.startswith(_API)
        for prefix in (*_API, "/datasets/"):
            path = path.removeprefix(prefix)
        parts = unquote(path).strip("/").split("/")
        repository, revision = "/".join(parts[:2]), parts[3] if len(parts) > 3 else "main"
        if repository in self.refusals and not (api and self.refusals[repository][1] == "GatedRepo"):
            status, code = self.refusals[repository]
            return status, {"x-error-code": code, "x-error-message": "refused"}, b""
        commits = self.models.get(repository)
        if commits is None:
            return 404, {"x-error-code": "RepoNotFound", "x-error-message": "Repository not found"}, b""
        commit = revision if revision in commits else self.names[repository].get(revision)
        if commit is None:
            return 404, {"x-error-code": "RevisionNotFound", "x-error-message": f"Invalid rev id: {revision}"}, b""
        if api:
            if "tree" in parts[2:3]:
                rows = [{"type": "file", "path": name, "oid": "0", "size": len(file_content)}
                        for name, file_content in commits[commit].items()]  # fmt: skip
                return 200, {"content-type": "application/json"}, json.dumps(rows).encode()
            listed = [
                {"rfilename": name, "size": len(file_content)} for name, file_content in commits[commit].items()
            ]
            body = {"id": repository, "modelId": repository, "sha": commit, "siblings": listed}
            return 200, {"content-type": "application/json"}, json.dumps(body).encode()
        content = commits[commit].get("/".join(parts[4:]))
        if content is None:
            return 404, {"x-error-code": "EntryNotFound", "x-error-message": "Entry not found"}, b""
        etag = hashlib.sha1(content).hexdigest()
        return 200, {"etag": f'"{etag}"', "x-repo-commit": commit}, content

    def answer(self, path: str, body: bytes) -> Any:
        """What the hub says to a request."""
        if "/preupload/" in path:
            files = json.loads(body)["files"]
            uploads = [{"path": file["path"], "uploadMode": "regular", "shouldIgnore": False} for file in files]
            return {"files": uploads}
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
    stand_in = Hub()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length") or 0))
            token = str(self.headers.get("authorization"))
            stand_in.requests.append((self.command, self.path, token))
            status = 200
            if stand_in.failures and "/commit/" in self.path:
                status = stand_in.failures.pop(0)
            if status == 0:
                self.close_connection = True
                self.connection.close()
                return
            content = json.dumps(stand_in.answer(self.path, body) if status == 200 else {"error": "no"}).encode()
            self.send_response(status)
            self.send_header("content-type", "application/json")
            self.send_header("content-length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def do_GET(self) -> None:
            served = self.path.startswith("/api/models/") or any(
                f"/datasets/{name}" in self.path for name in stand_in.models
            )
            if not served and "/resolve/" not in self.path:
                self.do_POST()
                return
            stand_in.requests.append((self.command, self.path, str(self.headers.get("authorization"))))
            status, headers, body = stand_in.download(self.path.partition("?")[0])
            self.send_response(status)
            for name, value in ({"content-length": str(len(body))} | headers).items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)

        def do_HEAD(self) -> None:
            self.do_GET()

        def log_message(self, *_: object) -> None:
            """Nothing is printed."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    stand_in.address = f"http://127.0.0.1:{server.server_port}"
    Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
    try:
        yield stand_in
    finally:
        server.shutdown()
        server.server_close()
