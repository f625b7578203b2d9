"""The server of the viewer, and its export as a folder."""

import gzip
import hashlib
import http.client
import json
import os
import re
import shutil
import socket
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UnknownCategoryError, UsageError
from probe_kit.runs import Run, commits, open_run, seal
from probe_kit.runs.root import Root
from probe_kit.runs.store import locate
from probe_kit.suite import Suite
from probe_kit.view import write_viewer
from probe_kit.view.catalogue import Catalogue
from probe_kit.view.export import APP, page_files
from tests.support.little_run import episode, little_plan, little_writer
from tests.view.payload_reader import read_payload

pytest.importorskip("starlette", reason="the server of the viewer is not installed (starlette, uvicorn)")
pytest.importorskip("uvicorn", reason="the server of the viewer is not installed (starlette, uvicorn)")

Answer = tuple[int, Mapping[str, str], bytes]


class Client:
    """Asks a server with chosen headers, as any program on the machine can."""

    def __init__(self, port: int, token: str) -> None:
        self.port, self.token = port, token
        self.cookie = ""

    def ask(self, path: str, method: str = "GET", **headers: str) -> Answer:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        sent = {"Host": f"127.0.0.1:{self.port}", **({"Cookie": self.cookie} if self.cookie else {})}
        sent |= {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, headers=sent)
        answer = connection.getresponse()
        received = answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        connection.close()
        return received

    def admit(self) -> None:
        """Open the address that the command prints."""
        status, headers, page = self.ask(f"/?token={self.token}", Sec_Fetch_Site="cross-site")
        assert (status, b'content="0; url=/"' in page) == (200, True)
        assert {"HttpOnly", "SameSite=strict"} <= set(re.split("; ?", headers["set-cookie"]))
        self.cookie = headers["set-cookie"].partition(";")[0]


@contextmanager
def served(runs: list[Run]) -> Iterator[Client]:
    from probe_kit.view.server import ViewerServer

    server = ViewerServer(Catalogue(runs))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield Client(server.port, server.address.partition("token=")[2])
    finally:
        server.stop()
        thread.join(30)


@pytest.fixture(scope="module")
def server(little_runs: Path) -> Iterator[Client]:
    with served([open_run(little_runs / "run")]) as viewer:
        viewer.admit()
        yield viewer


def test_the_icon_needs_no_cookie_because_the_page_that_leads_in_has_none_yet(server: Client) -> None:
    newcomer = Client(server.port, server.token)
    status, headers, content = newcomer.ask("/favicon.ico", Sec_Fetch_Site="same-origin")
    assert (status, headers["content-type"].partition(";")[0]) == (200, "image/svg+xml")
    assert content == server.ask("/app/icon.svg")[2]
    assert newcomer.ask("/app/icon.svg", Sec_Fetch_Site="same-origin")[0] == 403
    assert newcomer.ask("/favicon.ico", Sec_Fetch_Site="cross-site")[0] == 403
    assert newcomer.ask("/favicon.ico", Host="example.org")[0] == 400


@pytest.mark.slow
def test_the_page_and_the_payloads_are_those_of_an_export(server: Client, exported: Path) -> None:
    folder = exported.parent
    files = ["app/page.js", "app/page.css", "data/run/episodes.js", "data/run/e/00003.js", "data/run/f/00001.webp"]
    for file in ["index.html", *files]:
        status, headers, content = server.ask(f"/{file.removeprefix('index.html')}")
        assert (status, content) == (200, (folder / file).read_bytes()), file
        assert "default-src 'none'" in headers["content-security-policy"]
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in headers
    name, value = read_payload(server.ask("/data/index.js")[2])
    assert (name, [run["key"] for run in value["runs"]]) == ("index", ["run"])


@pytest.mark.parametrize(
    ("method", "headers", "status"),
    [
        ("GET", {"Host": "evil.example"}, 400),
        ("GET", {"Host": "127.0.0.1"}, 400),
        ("GET", {"Host": "127.0.0.1:1"}, 400),
        ("POST", {}, 403),
        ("DELETE", {}, 403),
        ("GET", {"Sec_Fetch_Site": "cross-site"}, 403),
        ("GET", {"Sec_Fetch_Site": "same-site"}, 403),
        ("GET", {"Cookie": ""}, 403),
        ("GET", {"Cookie": "probe_kit_view=guess"}, 403),
        ("GET", {"Sec_Fetch_Site": "same-origin"}, 200),
        ("HEAD", {}, 200),
    ],
)
def test_only_the_page_itself_is_answered(
    server: Client, method: str, headers: dict[str, str], status: int
) -> None:
    for path in ("/", "/data/run/run.js", "/follow"):
        code, _, content = server.ask(path, method, **headers)
        assert code == (204 if status == 200 and path == "/follow" else status)
        assert status == 200 or b"put(" not in content


@pytest.mark.parametrize(
    "foreign",
    [
        "a=b", "=", ";;;", "a", "[x]=1", "a b=c", 'q="un;closed', "$Version=1", "é=ü", "x={json: 1}", "a=\x01",
        "n=" + "v" * 60_000, "; ".join(f"c{number}={'v' * 4000}" for number in range(180)),
        "{name}=of-another-server", "{name}=", '{name}="quoted"',
    ],
)  # fmt: skip
def test_cookies_of_other_servers_of_this_machine_do_not_lock_the_page_out(server: Client, foreign: str) -> None:
    name = server.cookie.partition("=")[0]
    foreign = foreign.replace("{name}", name)
    for cookie in (f"{foreign}; {server.cookie}", f"{server.cookie}; {foreign}"):
        assert server.ask("/data/index.js", Cookie=cookie)[0] == 200
    assert server.ask("/data/index.js", Cookie=foreign)[0] == 403


def test_the_token_stands_on_no_command_line_and_in_a_file_of_this_user_alone(
    little_runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`webbrowser.open` puts its argument on the command line of a browser."""
    from probe_kit.view.server import ViewerServer

    opened: list[tuple[str, str, int, int]] = []

    def open_browser(address: str) -> bool:
        file = Path(address.removeprefix("file://"))
        modes = file.stat().st_mode & 0o777, file.parent.stat().st_mode & 0o777
        opened.append((address, file.read_text(encoding="utf-8"), *modes))
        return True

    monkeypatch.setattr("webbrowser.open", open_browser)
    monkeypatch.setattr(ViewerServer, "run", lambda _: None)
    before = os.umask(0)
    result = CliRunner().invoke(app, ["view", str(little_runs / "run")])
    os.umask(before)
    assert result.exit_code == 0, result.output
    [(address, page, file_mode, folder_mode)] = opened
    printed = result.stdout.splitlines()[0]
    assert "token" not in address
    assert printed.partition("token=")[2] not in address
    assert f'content="0; url={printed}"' in page
    assert (file_mode, folder_mode) == (0o600, 0o700)
    assert not Path(address.removeprefix("file://")).parent.exists()


def test_a_port_that_is_in_use_is_refused_by_number(server: Client, little_runs: Path) -> None:
    command = ["view", str(little_runs / "run"), "--no-browser", "--port", str(server.port)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2
    assert f"port {server.port} of 127.0.0.1: Address already in use" in result.stderr


def test_no_other_address_than_that_of_loopback_is_opened(server: Client) -> None:
    with pytest.raises(OSError):  # noqa: PT011 - refused, or no such address
        socket.create_connection(("127.0.0.2", server.port), timeout=10)


@pytest.mark.parametrize(
    "request_text",
    [
        "GET /data/index.js HTTP/1.0\r\n\r\n",
        "GET /data/index.js HTTP/1.1\r\nHost: evil.example\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n",
        "GET http://evil.example/data/index.js HTTP/1.1\r\nHost: evil.example\r\nCookie: {cookie}\r\n\r\n",
        "GET /data/index.js HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}x; a=\x01\r\n\r\n",
        "GET /data/index.js HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: x3JJHMbDL1EzLkh9GBhXDw==\r\nSec-WebSocket-Version: 13\r\n\r\n",
        "TRACE / HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n",
    ],
    ids=["no host", "two hosts", "absolute address", "wrong cookie", "websocket", "trace"],
)
def test_a_request_that_no_browser_makes_of_the_page_gets_nothing(server: Client, request_text: str) -> None:
    sent = request_text.format(host=f"127.0.0.1:{server.port}", cookie=server.cookie)
    with socket.create_connection(("127.0.0.1", server.port), timeout=60) as connection:
        connection.sendall(sent.encode("latin-1"))
        answer = connection.recv(4096)
    assert re.match(rb"HTTP/1.1 40[03] ", answer)
    assert b"put(" not in answer


def test_a_wrong_token_admits_nothing(server: Client) -> None:
    for token in ("", "x", server.token[:-1], f"{server.token}x", "%00"):
        status, headers, _ = server.ask(f"/?token={token}", Cookie="")
        assert status == 403
        assert "set-cookie" not in headers


@pytest.mark.parametrize(
    "path",
    [
        "/data/../run.json", "/data/..%2frun.json", "/data//etc/passwd", "/data/run/run.json", "/nothing",
        "/data/run/f/00099.webp", "/data/run/f/../../index.js", "/app/../commands.py", "/app/..%2fcommands.py",
        "/app/", "/data/", "/data/run/run", "/data/other/run.js", "/data/run/map/%2e%2e.js",
        "/data/run/e/99999.js",
    ],
)  # fmt: skip
def test_another_name_is_not_found(server: Client, path: str) -> None:
    status, _, content = server.ask(path)
    assert status == 404
    assert b"put(" not in content


def test_what_the_browser_has_is_not_sent_again_and_large_payloads_are_packed(server: Client) -> None:
    for path in ("/data/run/episodes.js", "/app/page.js", "/data/run/f/00000.webp"):
        _, headers, content = server.ask(path)
        again, _, nothing = server.ask(path, If_None_Match=headers["etag"])
        assert (again, nothing) == (304, b"")
        _, packed_headers, packed = server.ask(path, Accept_Encoding="gzip")
        if path.endswith(".js"):
            assert packed_headers["content-encoding"] == "gzip"
            assert gzip.decompress(packed) == content
            assert len(packed) < len(content)


def test_a_page_is_told_why_an_episode_of_a_damaged_run_cannot_be_shown(little_runs: Path, tmp_path: Path) -> None:
    run = tmp_path / "<b>" / "damaged"
    shutil.copytree(little_runs / "run", run)
    with served([open_run(run)]) as damaged:
        damaged.admit()
        picture = run / "frames" / "00000000.webp"
        picture.write_bytes(picture.read_bytes()[:-1])
        status, headers, content = damaged.ask("/data/damaged/e/00000.js")
        assert (status, headers["content-type"]) == (200, "text/javascript; charset=utf-8")
        refusal = re.fullmatch(rb'refuse\("damaged/e/00000",(".*")\)\n', content)
        assert refusal, content
        assert json.loads(refusal[1]).startswith("damaged/frames/00000000.webp has ")
        assert str(tmp_path).encode() not in content
        assert b"<" not in content
        assert damaged.ask("/data/damaged/e/00001.js")[2].startswith(b"put(")
        assert damaged.ask("/data/damaged/f/00000.webp")[0] == 500


def test_what_a_browser_has_of_a_former_server_is_sent_again(server: Client, little_runs: Path) -> None:
    """Behind one port the next server may have another VLM run, intervention or label beside equal commits."""
    _, headers, content = server.ask("/data/run/run.js")
    with served([open_run(little_runs / "run"), open_run(little_runs / "other")]) as later:
        later.admit()
        status, _, again = later.ask("/data/run/run.js", If_None_Match=headers["etag"])
    assert (status, again[:20]) == (200, content[:20])


@pytest.mark.slow
def test_episodes_that_are_committed_while_the_page_is_open_are_followed(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("probe_kit.view.server.TICK_S", 0.05)
    plan = little_plan(small_suite.select(["color"]), 0, 4)
    writer = little_writer(locate(tmp_path / "run"), plan)
    writer.write(episode(plan, 0))
    with served([open_run(tmp_path / "run", allow_partial=True)]) as client:
        client.admit()
        connection = http.client.HTTPConnection("127.0.0.1", client.port, timeout=60)
        host = {"Host": f"127.0.0.1:{client.port}", "Cookie": client.cookie}
        connection.request("GET", "/follow", headers=host)
        stream = connection.getresponse()
        assert stream.getheader("content-type", "").startswith("text/event-stream")

        def next_count() -> int:
            while True:
                line = stream.readline().decode()
                if line.startswith("data: "):
                    event = json.loads(line.removeprefix("data: "))
                    assert (event["run"], event["planned"], event["failed"]) == ("run", 4, 0)
                    return int(event["committed"])

        assert next_count() == 1
        for number in (1, 2, 3):
            writer.write(episode(plan, number))
            assert next_count() == number + 1
            _, value = read_payload(client.ask("/data/run/episodes.js")[2])
            assert value["number"] == list(range(number + 1))
        connection.close()
    seal(tmp_path / "run")


def test_a_grown_run_reads_new_commits_only_and_is_the_run_that_is_opened(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = little_plan(small_suite.select(["color"]), 0, 5)
    writer = little_writer(locate(tmp_path / "run"), plan)
    for number in (0, 3):
        writer.write(episode(plan, number))
    run = open_run(tmp_path / "run", allow_partial=True)
    for number in (1, 4):
        writer.write(episode(plan, number))
    read: list[int] = []
    reading = commits.read_commit

    def noted(root: Root, number: int, key: str, raw: bytes) -> commits.Commit:
        read.append(number)
        return reading(root, number, key, raw)

    monkeypatch.setattr(commits, "read_commit", noted)
    grown = run.grown()
    assert read == [1, 4]
    assert run.episodes["episode"].tolist() == [0, 3]
    opened = open_run(tmp_path / "run", allow_partial=True)
    assert grown.stamp == opened.stamp
    assert grown.episodes.equals(opened.episodes)


MOST_BYTES = 130_000
"""Of the page's own files, without licences."""


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_the_same_runs_give_the_same_bytes(little_runs: Path, exported: Path, tmp_path: Path) -> None:
    again = write_viewer([open_run(little_runs / name) for name in ("run", "other")], tmp_path / "again")
    first = contents(exported.parent)
    assert first == contents(again.parent)
    assert {"index.html", "README", "data/index.js", "data/run/e/00000.js", "data/other/run.js"} <= first.keys()
    assert [name for name in first if name.endswith(".webp")] == [
        name for name in first if re.search(r"/f/0000[01]\.webp$", name)
    ]


@pytest.mark.slow
def test_an_export_names_neither_folders_nor_users_of_this_machine(little_runs: Path, tmp_path: Path) -> None:
    private_folder = tmp_path / "home" / "jane-doe" / "secret project"
    shutil.copytree(little_runs / "run", private_folder / "run")
    page = write_viewer([open_run(private_folder / "run")], tmp_path / "out")
    for name, content in contents(page.parent).items():
        for word in (str(tmp_path), "jane-doe", "secret project"):
            assert word.encode() not in content, name


@pytest.mark.slow
def test_an_export_replaces_a_former_one_and_no_other_folder(little_runs: Path, tmp_path: Path) -> None:
    run = open_run(little_runs / "run")
    folder = tmp_path / "out"
    write_viewer([run], folder)
    (folder / "data" / "left.js").write_text("put(1)", encoding="utf-8")
    write_viewer([run], folder, frames=False)
    assert not (folder / "data" / "left.js").exists()
    assert not list(folder.rglob("*.webp"))
    (folder / "thesis.tex").write_text("mine", encoding="utf-8")
    with pytest.raises(UsageError, match=r"holds .* and is no former export"):
        write_viewer([run], folder)
    assert (folder / "thesis.tex").read_text(encoding="utf-8") == "mine"
    with pytest.raises(UsageError, match="is a file; give a folder"):
        write_viewer([run], folder / "thesis.tex")


@pytest.mark.slow
def test_an_export_of_some_categories_holds_no_other(little_runs: Path, tmp_path: Path) -> None:
    run = open_run(little_runs / "run")
    with pytest.raises(UnknownCategoryError, match="no run has the category 'shape'; they have color"):
        write_viewer([run], tmp_path / "out", categories=["shape"])
    page = write_viewer([run], tmp_path / "out", categories=["color"])
    assert len(list((page.parent / "data" / "run" / "e").iterdir())) == len(run.episodes)


@pytest.mark.slow
def test_the_command_prints_the_page(little_runs: Path, tmp_path: Path) -> None:
    arguments = ["view", str(little_runs / "run"), "--export", str(tmp_path / "out"), "--without-frames"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert result.stdout.strip() == str(tmp_path / "out" / "index.html")


def test_the_vendored_file_is_the_one_that_its_record_names() -> None:
    rows = re.findall(
        r"^\| `(\S+)` .* `([0-9a-f]{64})` \|$", (APP / "VENDORED.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert [name for name, _ in rows] == ["preact-htm.js"]
    for name, recorded in rows:
        assert hashlib.sha256((APP / name).read_bytes()).hexdigest() == recorded
    assert "Apache License" in (APP / "LICENSE-htm.txt").read_text(encoding="utf-8")
    assert "MIT License" in (APP / "LICENSE-preact.txt").read_text(encoding="utf-8")


def test_the_page_is_small_and_names_no_other_host() -> None:
    shipped_files = {name: content for name, content in page_files().items() if "LICENSE" not in name}
    assert sum(map(len, shipped_files.values())) <= MOST_BYTES
    for name, content in shipped_files.items():
        hosts = set(re.findall(rb"(?:https?:)?//([a-z0-9-]+\.[a-z]{2,}[a-z0-9.-]*)", content))
        assert hosts <= {b"www.w3.org"}, name


def test_the_page_runs_its_own_scripts_only() -> None:
    page = page_files()["index.html"].decode()
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
    assert policy
    assert "default-src 'none'" in policy[1]
    assert "unsafe" not in policy[1]
    scripts = re.findall(r"<script([^>]*)>(.*?)</script>", page)
    assert scripts
    assert all(re.fullmatch(r' src="app/[a-z-]+\.js"', source) and not body for source, body in scripts)
    assert {re.search(r"app/[\w.-]+", source)[0] for source, _ in scripts} == {
        name for name in page_files() if name.endswith(".js")
    }
    for name, content in page_files().items():
        assert not re.search(rb"innerHTML|\beval\(|new Function\(|document\.write", content) or "preact" in name, (
            name
        )


def test_options_of_an_export_need_its_folder(little_runs: Path) -> None:
    result = CliRunner().invoke(app, ["view", str(little_runs / "run"), "--without-frames"])
    assert result.exit_code == 2
    assert "give --export FOLDER" in result.stderr
