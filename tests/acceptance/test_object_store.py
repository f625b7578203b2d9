"""A run in an object store: extract, train and retention give what they give in a folder."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.request import Request, urlopen

import pytest

import probe_kit as pk
from tests.acceptance.product import probe_kit

SETTINGS = (
    *("--model", "pi0-tiny", "--no-act", "--categories", "color", "--items", "10"),
    *("--env-workers", "0", "--batch", "1"),
)
PROBES = ("--permutations", "3", "--controls", "none")


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """The URL of an empty bucket on a server of this process, to which the environment leads."""
    moto = pytest.importorskip("moto.server", reason="moto is not installed")
    pytest.importorskip("obstore", reason="obstore is not installed (extra `remote`)")
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log(self, *_: object) -> None:
            """Log nothing."""

    app = moto.DomainDispatcherApplication(moto.create_backend_app)
    server = make_server("127.0.0.1", 0, app, threaded=True, request_handler=Quiet)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    address = f"http://127.0.0.1:{server.port}"
    key = "AWS4-HMAC-SHA256 Credential=nobody/20260101/us-east-1/s3/aws4_request"
    urlopen(Request(f"{address}/acceptance", method="PUT", headers={"Authorization": key})).close()
    variables = {
        "AWS_ENDPOINT_URL": address,
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing",
        "AWS_REGION": "us-east-1",
        "AWS_ALLOW_HTTP": "true",
        "AWS_TIMEOUT": "5m",  # other tests may use the same cores
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in variables.items():
            patch.setenv(name, value)
        yield "s3://acceptance"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.slow
def test_a_study_in_a_bucket_equals_the_same_in_a_folder(bucket: str, tmp_path: Path) -> None:
    tables = []
    for run in (f"{bucket}/study/run", str(tmp_path / "run")):
        probe_kit("extract", *SETTINGS, "--out", run)
        probe_kit("train", run, *PROBES)
        assert probe_kit("run", "verify", run, "--deep", "--json").json()["ok"]
        tables.append(json.loads(probe_kit("retention", run, "--format", "json").out.replace(run, "RUN")))
    assert tables[0] == tables[1]
    assert tables[0][0]["backbone"]["score"] is not None
    remote, local = pk.open_run(f"{bucket}/study/run"), pk.open_run(tmp_path / "run")
    assert remote.stamp == local.stamp
    site = pk.Site("expert", 2, iteration=5)
    assert remote.column(site, "mean").tobytes() == local.column(site, "mean").tobytes()
    assert remote.episodes["episode_id"].tolist() == local.episodes["episode_id"].tolist()


def test_a_run_in_a_bucket_is_verified_and_tabled_and_refuses_other_settings(bucket: str) -> None:
    answer = probe_kit("retention", f"{bucket}/nowhere", code=2)
    assert "RunNotFoundError" in answer.err
    few = f"{bucket}/few"
    typed = (
        "extract",
        "--model",
        "idle",
        "--categories",
        "color",
        "--items",
        "2",
        "--env-workers",
        "0",
        "--out",
        few,
    )
    probe_kit(*typed, "--max-steps", "1")
    verified = probe_kit("run", "verify", few, "--deep", "--json").json()
    assert verified["ok"]
    assert verified["committed"] == len(pk.open_run(few).episodes) == 4
    rows = probe_kit("retention", few, "--format", "json").json()
    assert {(row["success"]["n_episodes"], row["success"]["sr"]) for row in rows} == {(4, 0)}
    refused = probe_kit(*typed, "--max-steps", "2", code=3)
    assert "SettingsMismatchError" in refused.err
    assert "max_steps" in refused.text
