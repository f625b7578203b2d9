"""Scenes that are built once for all tests of the environment, and an item with two pictures on disk."""

from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path

import pytest
from PIL import Image

from probe_kit.env import Act2AnswerEnv, Outcome, SceneSpec, ScriptedExpert
from probe_kit.env.arm import ARMS
from probe_kit.suite.items import Item


@pytest.fixture(scope="session")
def shared_env() -> Iterator[Act2AnswerEnv]:
    """The default environment; a test that uses it begins with `reset`."""
    env = Act2AnswerEnv()
    yield env
    env.close()


@pytest.fixture(scope="session", params=ARMS)
def arm_env(request: pytest.FixtureRequest) -> Iterator[Act2AnswerEnv]:
    """The default scene with each arm in turn."""
    if request.param == "widowx":
        pytest.importorskip("rtbdata")
    env = Act2AnswerEnv(SceneSpec(arm=request.param))
    yield env
    env.close()


@pytest.fixture
def make_env() -> Iterator[Callable[..., Act2AnswerEnv]]:
    """Makes environments with fields of the default scene replaced, and closes them after the test."""
    environments: list[Act2AnswerEnv] = []

    def make(preset: str = "bridge", **changes: object) -> Act2AnswerEnv:
        if changes.get("arm") == "widowx":
            pytest.importorskip("rtbdata")
        environments.append(Act2AnswerEnv(SceneSpec.preset(preset, **changes)))
        return environments[-1]

    yield make
    for env in environments:
        env.close()


@pytest.fixture
def item(tmp_path: Path) -> Item:
    """A question whose correct picture, a red one, lies on the left in the original layout."""
    Image.new("RGB", (40, 40), "red").save(tmp_path / "red.png")
    Image.new("RGB", (40, 40), "cyan").save(tmp_path / "cyan.png")
    blank = {f.name: "" for f in fields(Item)}
    fields_given = {
        "item_id": "color-0001",
        "instruction": "Put the cube on the red picture",
        "correct_side": "left",
        "left_file_name": "red.png",
        "right_file_name": "cyan.png",
        "folder": tmp_path,
        "source": {},
        "gen": {},
    }
    return Item(**(blank | fields_given))  # type: ignore[arg-type]


@pytest.fixture
def play() -> Callable[..., Outcome]:
    """Plays one expert episode without pictures and returns its outcome."""

    def run(env: Act2AnswerEnv, seed: int, layout: str = "original", mirrored: bool = False) -> Outcome:
        env.reset(seed=seed, options={"layout": layout})
        expert = ScriptedExpert(env, mirrored=mirrored)
        expert.reset()
        while not env.trial.over:
            env.advance(expert.act())
        return env.outcome()

    return run
