"""Ray: the same worker on a cluster. Slow to start anywhere, and on starved machines it may not start at all."""

import threading
import time
from pathlib import Path

import psutil
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import MissingExtraError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.suite import build_suite


def test_without_ray_the_error_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    suite = build_suite(tmp_path / "suite", ["color"], 2)
    with pytest.raises(MissingExtraError, match=r"probe-kit\[ray\]"):
        extract_run(ExtractSettings("expert", suite=suite.folder, ray="auto"), tmp_path / "run")


@pytest.mark.slow
def test_an_actor_killed_in_mid_run_changes_nothing_in_the_result(tmp_path: Path) -> None:
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
        with_ray = ExtractSettings(**{**vars(settings), "ray": "auto"})
        run = extract_run(with_ray, tmp_path / "run").path
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
    (actor,) = [process for process in started_here if "RayActor" in " ".join(process.cmdline())]
    actor.kill()
