"""Language models propose, people decide; the service is a stand-in on this machine."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from probe_kit.errors import SuiteError, UsageError
from probe_kit.suite.converters import convert

GOOD = {"instruction": "Put the cube on the calmer sky", "object": "calmer sky", "polarity": "none", "keep": True}


class Service:
    """Answers every request with `reply` and remembers them."""

    def __init__(self) -> None:
        self.reply: object = GOOD
        self.requests: list[dict[str, object]] = []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                outer.requests.append({"path": self.path, **json.loads(body)})
                content = {"choices": [{"message": {"content": json.dumps(outer.reply)}}]}
                self.send_response(200)
                self.end_headers()
                self.wfile.write(json.dumps(content).encode())

            def log_message(self, *_: object) -> None:
                pass

        self.server = HTTPServer(("127.0.0.1", 0), Handler)
        self.base = f"http://127.0.0.1:{self.server.server_port}/v1"


@pytest.fixture
def service() -> Iterator[Service]:
    running = Service()
    threading.Thread(target=running.server.serve_forever, daemon=True).start()
    yield running
    running.server.shutdown()
    running.server.server_close()


def test_a_proposal_waits_for_a_person_unless_models_are_trusted(
    service: Service, compbench_root: Path, tmp_path: Path
) -> None:
    llm = {"llm_base": service.base, "llm_model": "tiny", "llm_cache": str(tmp_path / "cache")}
    source = ("mllm-compbench", compbench_root)
    waiting = convert(*source, tmp_path / "waiting", categories=["attribute"], **llm)
    assert "calmer sky" not in {item.object_phrase for item in waiting.items}
    trusted = convert(*source, tmp_path / "trusted", categories=["attribute"], trust_llm=True, **llm)
    (item,) = [item for item in trusted.items if item.object_phrase == "calmer sky"]
    assert (item.rule_id, item.curation_status) == ("llm", "llm-trusted")
    assert trusted.card["curation"] == ["llm-trusted", "rules-only"]
    assert len(service.requests) == 1, "the second run is answered by the cache"
    assert service.requests[0]["path"] == "/v1/chat/completions"
    assert service.requests[0]["temperature"] == 0


@pytest.mark.parametrize(
    "reply",
    ["no object", {**GOOD, "keep": False}, {**GOOD, "instruction": "Take the calmer sky"}, {**GOOD, "object": ""}],
)
def test_an_unusable_reply_leaves_the_question_unworded(
    service: Service, compbench_root: Path, tmp_path: Path, reply: object
) -> None:
    service.reply = reply
    llm = {"llm_base": service.base, "llm_model": "tiny", "llm_cache": str(tmp_path / "cache"), "trust_llm": True}
    suite = convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["attribute"], **llm)
    assert {item.rule_id for item in suite.items} == {"R2"}


def test_a_service_that_does_not_answer_is_an_error(compbench_root: Path, tmp_path: Path) -> None:
    llm = {"llm_base": "http://127.0.0.1:9", "llm_model": "tiny", "llm_cache": str(tmp_path / "cache")}
    with pytest.raises(SuiteError, match="gave no usable reply"):
        convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["attribute"], **llm)
    assert not (tmp_path / "suite").exists()


def test_half_of_the_settings_are_refused(compbench_root: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="llm_base needs llm_model and llm_cache"):
        convert("mllm-compbench", compbench_root, tmp_path / "suite", llm_base="http://127.0.0.1:9")
