"""lerobot's environments behind the contract: one that a test registers, and those without a simulator."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from probe_kit.errors import MissingExtraError, OwnEnvironmentError, UsageError
from probe_kit.extract import EnvironmentSettings, check_environment
from probe_kit.extract.sources.environment_source import EnvironmentSource, open_environment
from probe_kit.extract.sources.lerobot_env import LeRobotEnvironment
from tests.support.reach_env import Reach

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def _registered() -> None:
    import registered_reach  # noqa: F401 - it registers configurations


def test_an_environment_of_lerobot_keeps_the_contract() -> None:
    source = EnvironmentSettings("registered_reach:lerobot_reach", {"per_task": 2})  # type: ignore[arg-type]
    assert [check.problem for check in check_environment(source) if check.problem] == []


def test_observations_and_actions_pass_lerobots_processors() -> None:
    played, plain = LeRobotEnvironment("probe_kit_reach", instruction="reach it", per_task="3"), Reach()
    (_, second, _) = played.episodes()
    assert (second.seed, second.group, second.instruction) == (1, None, "reach it")
    assert "Reach-v0" in played.revision
    assert "lerobot 0." in played.revision
    begin = played.reset(second)
    expected, _ = plain.reset(seed=1)
    np.testing.assert_array_equal(begin.observation.image, expected["pixels"][::-1, ::-1])
    np.testing.assert_array_equal(begin.observation.state, expected["agent_pos"])
    action = np.full(7, 0.005, np.float32)
    step = played.step(action)
    observed, reward, *_ = plain.step(2 * action)
    np.testing.assert_allclose(step.observation.state, observed["agent_pos"])
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
        (
            "lerobot:probe_kit_old",
            {},
            UsageError,
            r"has no task 'probe_kit_old-Reach-v9', lerobot's default .*It has Reach-v0, .*task=Reach-v0",
        ),
        ("lerobot:probe_kit_old", {"task": "Rech-v0"}, UsageError, "has no task 'Rech-v0' .*task=Reach-v0"),
        (
            "lerobot:probe_kit_renamed",
            {},
            UsageError,
            r"configuration \(TypeError: .*visualization_width.*\). It is task='Reach-v0', .*width=96",
        ),
        ("lerobot:probe_kit_reach", {"per_task": "0"}, UsageError, "per_task=0; expected a number of episodes"),
    ],
)
def test_a_lerobot_environment_that_cannot_be_played_is_refused_by_name(
    name: str, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        open_environment(EnvironmentSettings(name, options))


@pytest.mark.parametrize("name", ["vlabench", "robotwin"])
def test_a_simulator_that_is_imported_late_is_named_at_the_first_reset(name: str) -> None:
    played = LeRobotEnvironment(name, instruction="x", per_task=1)
    with pytest.raises(MissingExtraError, match=f"lerobot:{name} needs a simulator"):
        played.reset(next(iter(played.episodes())))


def test_an_episode_ends_at_lerobots_limit_and_every_seed_is_a_group() -> None:
    source = EnvironmentSettings(
        "lerobot:probe_kit_reach", {"instruction": "x", "per_task": 6, "episode_length": 300}
    ).open()  # type: ignore[arg-type]
    assert source.settings.steps() == 300
    rows = source.rows(0)
    assert len({row.columns["group_id"] for row in rows}) == len(rows) == 6
    assert "every episode is one" in source.describe(rows)["groups"]


def test_tasks_of_several_limits_end_at_their_own() -> None:
    source = EnvironmentSettings("lerobot:probe_kit_suites", {"instruction": "x", "per_task": 1}).open()  # type: ignore[arg-type]
    assert {row.columns["episode_id"]: row.columns["max_steps"] for row in source.rows(0)} == {
        "short-0/0000": 280,
        "long-0/0000": 520,
    }


def test_more_seeds_than_stored_initial_states_share_a_group(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seed n starts from the n-th state, counted round, as lerobot's LIBERO does."""
    import reach_env

    monkeypatch.setattr(reach_env.Reach, "init_state_id", 0, raising=False)
    monkeypatch.setattr(reach_env.Reach, "_init_states", [0, 1, 2], raising=False)
    groups = [episode.group for episode in LeRobotEnvironment("probe_kit_reach", 5, "x").episodes()]
    assert [groups[seed] == groups[0] for seed in range(5)] == [True, False, False, True, False]
    assert {episode.group for episode in LeRobotEnvironment("probe_kit_reach", 3, "x").episodes()} == {None}


def test_a_simulator_that_asks_a_question_at_its_import_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """As LIBERO does where nothing can answer."""

    def ask(_name: object, **_options: object) -> None:
        raise EOFError("EOF when reading a line")

    monkeypatch.setattr(gym, "make", ask)
    with pytest.raises(
        UsageError, match=r"asks a question .*python -c \"import tests\.extract\..*test_lerobot_env\""
    ):
        LeRobotEnvironment("probe_kit_reach", instruction="x")


def test_an_environment_without_a_text_asks_for_one() -> None:
    with pytest.raises(OwnEnvironmentError, match="has no instruction for probe_kit_reach-0; give one"):
        list(LeRobotEnvironment("probe_kit_reach").episodes())


@pytest.mark.parametrize(
    ("kind", "package", "options", "limit"),
    [
        ("pusht", "gym_pusht", {"instruction": "push the T"}, 300),
        ("aloha", "gym_aloha", {}, 400),
        ("metaworld", "metaworld", {"task": "push-v3"}, 500),
    ],
)
def test_a_real_simulator_ends_where_its_benchmark_does_and_repeats(
    kind: str, package: str, options: dict[str, Any], limit: int
) -> None:
    """Where its package is installed; the table of docs/own-environments.md has all that were run."""
    pytest.importorskip(package)
    source = EnvironmentSettings(f"lerobot:{kind}", {**options, "per_task": 6}).open()  # type: ignore[arg-type]
    assert isinstance(source, EnvironmentSource)
    source.rehearse(source.rows(0))
    assert source.settings.steps() == limit
    assert len({row.columns["group_id"] for row in source.rows(0)}) == 6
    assert len(set(source.starts.values())) == 2
