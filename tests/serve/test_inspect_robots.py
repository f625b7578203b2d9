"""The harness inspect-robots, whose own mock task is played through openpi with marks."""

import json
import subprocess
from pathlib import Path

import pytest

from probe_kit.runs import open_run
from tests.support.client_environments import client_python, drawing, server_process

pytestmark = pytest.mark.slow
PACKAGES = ("inspect-robots==0.60.0", "openpi-client==0.1.2", "numpy<2", "typing_extensions")
PAGE = Path(__file__).parents[2] / "docs" / "serve.md"
PLAYS = """
import json, sys
from inspect_robots import eval
from inspect_robots.mock import CubePickEmbodiment
from inspect_robots.scene import Scene
from inspect_robots.scorer import success_at_end
from inspect_robots.task import Epochs, Task

class Padded(Served):
    def state(self, observation):
        return np.resize(super().state(observation), 8)  # pi0-tiny reads eight numbers

policy = Padded(sys.argv[1])
scenes = [Scene(id=f"scene-{number}", instruction="reach the cube", init_seed=number) for number in range(4)]
task = Task(name="reach", scenes=scenes, scorer=success_at_end(), max_steps=8, epochs=Epochs(2))
(log,) = eval(task, policy, CubePickEmbodiment(goal_radius=0.9), log_dir=sys.argv[2])  # near enough for some
scores = {f"{sample.scene_id}/{n}": scores for sample in log.samples for n, scores in enumerate(sample.epochs)}
print(json.dumps([log.status, scores]))
"""


@pytest.fixture(scope="session")
def harness(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return client_python(tmp_path_factory, "inspect-robots", PACKAGES, "import inspect_robots, openpi_client")


def wrapper() -> str:
    """The policy as the page of the docs has it."""
    (block,) = [
        text for text in PAGE.read_text(encoding="utf-8").split("```") if "class Served(PolicyBase)" in text
    ]
    return block.removeprefix("python\n")


def test_rows_are_scenes_and_epochs_and_outcomes_are_those_of_the_log(harness: Path, tmp_path: Path) -> None:
    keys = ("--camera", "base=observation/image", "--state", "observation/state", "--accept-units")
    words = ("--instruction", "put the cube on the red shape", "--captured-calls", "1", "--episodes", "said")
    with server_process(tmp_path / "run", "--port", "0", *keys, *words) as (server, address):
        played = subprocess.run(
            [str(harness), "-c", wrapper() + PLAYS, f"{address}/harness", str(tmp_path / "logs")],
            env=drawing(), capture_output=True, check=False, timeout=200,
        )  # fmt: skip
    assert played.returncode == 0, played.stderr.decode()
    status, scores = json.loads(played.stdout.splitlines()[-1])
    assert status == "success"
    assert server.returncode == 0
    run = open_run(tmp_path / "run")
    assert len(run.episodes) == len(scores) == 8
    assert len({name.partition("/")[0] for name in scores}) == 4
    succeeded = {name: bool(values["success_at_end"]) for name, values in scores.items()}
    assert dict(zip(run.episodes["episode_id"], run.episodes["outcome"] == "success", strict=True)) == succeeded
    assert len(set(succeeded.values())) == 2, "outcomes differ"
    assert [name.partition("/")[0] for name in run.episodes["episode_id"]] == run.episodes["group_id"].tolist()
    assert (run.episodes["began"] == "said").all()
