"""lerobot's environments behind the contract: one that a test registers, and those without a simulator."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from probe_kit.errors import MissingExtraError, OwnEnvironmentError, UsageError
from probe_kit.extract import EnvSource, check_environment
from probe_kit.extract.sources.environment_source import open_environment
from probe_kit.extract.sources.lerobot_env import LeRobotEnvironment
from tests.support.reach_env import Reach

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def _registered() -> None:
    """An `EnvConfig` as lerobot's own are, whose processor turns pictures as that of LIBERO does."""
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.envs.configs import EnvConfig

    @EnvConfig.register_subclass("probe_kit_reach")
    @dataclass
    class ReachConfig(EnvConfig):
        task: str | None = "Reach-v0"
        episode_length: int = 8
        features: dict[str, PolicyFeature] = field(
            default_factory=lambda: {"action": PolicyFeature(type=FeatureType.ACTION, shape=(7,))}
        )

        @property
        def gym_kwargs(self) -> dict[str, Any]:
            return {"max_episode_steps": self.episode_length}

        def get_env_processors(self) -> tuple[Any, Any]:
            def turned(seen: dict[str, Any]) -> dict[str, Any]:
                return {**seen, "observation.image": seen["observation.image"].flip(dims=(2, 3))}

            def doubled(passed: dict[str, Any]) -> dict[str, Any]:
                return {"action": 2 * passed["action"]}

            return turned, doubled

    gym.register("gym_probe_kit_reach/Reach-v0", Reach)


def test_an_environment_of_lerobot_keeps_the_contract() -> None:
    source = EnvSource("lerobot:probe_kit_reach", {"instruction": "reach it", "per_task": 2})  # type: ignore[arg-type]
    assert [check.problem for check in check_environment(source) if check.problem] == []


def test_observations_and_actions_pass_lerobots_processors() -> None:
    played, plain = LeRobotEnvironment("probe_kit_reach", instruction="reach it", per_task="3"), Reach()
    (_, second, _) = played.episodes()
    assert (second.seed, second.group, second.instruction) == (1, "probe_kit_reach-0", "reach it")
    assert "Reach-v0" in played.revision
    assert "lerobot 0." in played.revision
    begin = played.reset(second)
    expected, _ = plain.reset(seed=1)
    np.testing.assert_array_equal(begin.observation.image, expected["pixels"][::-1, ::-1])
    np.testing.assert_array_equal(begin.observation.state, expected["agent_pos"])
    action = np.full(7, 0.005, np.float32)
    step = played.step(action)
    seen, reward, *_ = plain.step(2 * action)
    np.testing.assert_allclose(step.observation.state, seen["agent_pos"])
    assert step.facts == {"reward": pytest.approx(float(reward)), "success": False}
    played.close()


def test_fields_of_the_configuration_are_options() -> None:
    played = LeRobotEnvironment("probe_kit_reach", instruction="x", per_task=1, episode_length="2")
    played.reset(next(iter(played.episodes())))
    assert [played.step(np.zeros(7, np.float32)).done for _ in range(2)] == [False, True]


@pytest.mark.parametrize(
    ("name", "options", "error", "message"),
    [
        ("lerobot:pusht", {}, MissingExtraError, "needs a simulator that is not installed.*gym_pusht"),
        ("lerobot:libero", {}, MissingExtraError, "lerobot:libero needs a simulator"),
        ("lerobot:kitchen", {}, UsageError, "lerobot has no such environment; it has .*libero"),
        ("lerobot:isaaclab_arena", {}, UsageError, "would run code from the hub"),
        ("lerobot:probe_kit_reach", {"colour": "red"}, UsageError, "cannot be configured so: .*colour"),
        ("lerobot:gym_manipulator", {}, UsageError, "is no simulation"),
    ],
)
def test_what_cannot_be_played_is_named(
    name: str, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        open_environment(EnvSource(name, tuple(options.items())))


@pytest.mark.parametrize("name", ["vlabench", "robotwin"])
def test_a_simulator_that_is_imported_late_is_named_at_the_first_reset(name: str) -> None:
    played = LeRobotEnvironment(name, instruction="x", per_task=1)
    with pytest.raises(MissingExtraError, match=f"lerobot:{name} needs a simulator"):
        played.reset(next(iter(played.episodes())))


def test_an_environment_without_a_text_asks_for_one() -> None:
    with pytest.raises(OwnEnvironmentError, match="has no instruction for probe_kit_reach-0; give one"):
        list(LeRobotEnvironment("probe_kit_reach").episodes())
