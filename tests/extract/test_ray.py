"""Ray: the same worker on a cluster. Slow to start anywhere, and on starved machines it may not start at all."""

import re
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest

from probe_kit._execution.executor import WorkerLostWarning
from probe_kit._system.imports import install_command
from probe_kit.env import SceneSpec
from probe_kit.errors import MissingExtraError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.runs import Run, open_run, verify_run
from probe_kit.runs.layout import COMMITS
from probe_kit.runs.store import locate
from probe_kit.suite import build_suite
from tests.extract.two_nodes import TwoNodes, two_nodes, wait_for
from tests.runs.contents import objects


def test_without_ray_the_error_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    suite = build_suite(tmp_path / "suite", ["color"], 2)
    with pytest.raises(MissingExtraError, match=re.escape(install_command("ray"))):
        extract_run(ExtractSettings("expert", suite=suite.folder, ray="auto"), tmp_path / "run")


@pytest.mark.slow
def test_an_actor_killed_in_mid_run_changes_nothing_in_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_worker_niceness", "0")  # as in `two_nodes`
    ray = pytest.importorskip("ray", reason="Ray is not installed (extra `ray`)")
    try:
        ray.init(num_cpus=2, include_dashboard=False)
    except (RuntimeError, ConnectionError, TimeoutError, ray.exceptions.RayError) as error:
        pytest.skip(f"Ray does not start here: {error}")
    suite = build_suite(tmp_path / "suite", ["color"], 12)
    settings = ExtractSettings("expert", suite=suite.folder, scene=SceneSpec(max_steps=20), env_workers=0)
    try:
        plain = extract_run(settings, tmp_path / "plain").path
        killer = threading.Thread(target=_kill_the_actor, args=(tmp_path / "run",))
        killer.start()
        with pytest.warns(WorkerLostWarning):
            run = extract_run(settings.changed(ray="auto"), tmp_path / "run").path
        killer.join()
    finally:
        ray.shutdown()
    for path in sorted(plain.glob("commits/*.json")):
        assert (run / "commits" / path.name).read_bytes() == path.read_bytes()


def _kill_the_actor(run: Path) -> None:
    deadline = time.monotonic() + 300
    while not list(run.glob("commits/*.json")) and time.monotonic() < deadline:
        time.sleep(0.02)
    started_here = psutil.Process().children(recursive=True)
    (actor,) = [process for process in started_here if "RayWorker" in " ".join(process.cmdline())]
    actor.kill()


@pytest.mark.slow
def test_a_node_lost_in_mid_run_changes_nothing_in_the_bucket(tmp_path: Path, bucket_elsewhere: str) -> None:
    suite = build_suite(tmp_path / "suite", ["color"], 12)
    settings = ExtractSettings("pi0-tiny", suite=suite.folder, scene=SceneSpec(max_steps=4), tokens="all")
    plain = extract_run(settings, tmp_path / "plain")
    url = f"{bucket_elsewhere}/run"

    def lose(nodes: TwoNodes) -> int:
        wait_for(lambda: locate(url).keys(COMMITS) and nodes.is_playing())
        nodes.lose_the_second()
        return len(locate(url).keys(COMMITS))

    with two_nodes() as nodes, ThreadPoolExecutor(1) as thread:
        committed = thread.submit(lose, nodes)
        with pytest.warns(WorkerLostWarning) as warned:
            extract_run(settings.changed(ray=nodes.address, workers=2), url)
    assert 0 < committed.result() < len(plain.episodes)
    messages = [str(warning.message) for warning in warned]
    assert nodes.second_id in messages[0]
    assert "it held (" in messages[0]
    stored_run = open_run(url)
    assert stored_run.certificate["hooks_on_equals_hooks_off"]
    assert verify_run(url, deep=True).ok
    assert contents(stored_run) == contents(plain)


def contents(run: Run) -> dict[str, bytes]:
    """All but seconds, and certificates: each process writes one, with the hash of what it played first."""
    varying_keys = ("certificate", "times/")
    return {key: content for key, content in objects(run.location).items() if not key.startswith(varying_keys)}
