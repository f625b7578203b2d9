"""Where an episode ends, what a seed starts, and which way up pictures are: as the benchmark has it."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

from probe_kit.errors import OtherFramesError, OwnEnvironmentError, UsageError
from probe_kit.extract import EnvEpisode, EnvironmentSettings, check_environment
from probe_kit.extract.sources.environment import MAX_STEPS
from probe_kit.extract.sources.environment_source import EnvironmentPlayer, EnvironmentSource, open_environment
from probe_kit.extract.sources.environment_starts import start_digest
from probe_kit.extract.sources.player import Ending
from probe_kit.extract.sources.source import Played
from probe_kit.extract.sources.step_limits import declared_limit
from probe_kit.hooks import Observation
from probe_kit.runs.environment_success import EnvironmentSuccess
from probe_kit.runs.layout import AT_END, LIMIT, ONCE, START
from probe_kit.runs.plan import Row
from tests.support.reach_env import Reach, ReachEnv

HOME, REGISTERED = "reach_env:", "registered_reach:"


class Simulator(SimpleNamespace):
    """Something that can be reset and stepped."""

    def reset(self) -> None: ...

    def step(self, action: object) -> None: ...


class PerEpisode(ReachEnv):
    """Its episodes have limits of their own, as suites of LIBERO have."""

    def episodes(self) -> Any:
        """Two tasks."""
        for seed, limit in enumerate((280, 280, 520)):
            yield EnvEpisode(f"e{seed}", seed, "Put the cube on the red shape", None, limit)


def opened(name: str = HOME + "ReachEnv", **options: Any) -> EnvironmentSource:
    source = EnvironmentSettings(name, **options).open()
    assert isinstance(source, EnvironmentSource)
    return source


def words_of(source: EnvironmentSource) -> dict[str, str]:
    return source.describe(source.rows(0))


# -- limits -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("simulator", "limit"),
    [
        (gym.wrappers.TimeLimit(Reach(), 250), 250),
        (gym.wrappers.RecordEpisodeStatistics(gym.wrappers.TimeLimit(Reach(), 90)), 90),
        (Simulator(spec=SimpleNamespace(max_episode_steps=120)), 120),
        (Simulator(_max_episode_steps=500), 500),  # lerobot's Meta-World
        (Simulator(horizon=np.int64(1000)), 1000),  # robosuite
        (Simulator(max_path_length=400, spec=None), 400),  # Meta-World
        (Simulator(max_episode_steps=-1), None),
        (Simulator(horizon=True), None),
        (Reach(), None),
        (SimpleNamespace(horizon=7), None),  # nothing that is reset and stepped
    ],
)
@pytest.mark.parametrize("wrap", [lambda task: task, lambda task: {"task": task}, lambda task: [task, Reach()]])
def test_a_limit_is_that_of_the_simulator_that_an_environment_holds(
    simulator: Any, limit: int | None, wrap: Any
) -> None:
    assert declared_limit(SimpleNamespace(env=wrap(simulator)), "kitchen") == limit


def test_an_environment_says_its_limit_itself_and_the_longest_of_several_simulators_counts() -> None:
    simulators = [Simulator(horizon=horizon) for horizon in (100, 300)]
    assert declared_limit(SimpleNamespace(envs=simulators), "kitchen") == 300
    assert declared_limit(SimpleNamespace(envs=simulators, max_steps=50), "kitchen") == 50
    for wrong in (0, -3, "many", 1.5, True):
        with pytest.raises(OwnEnvironmentError, match=r"kitchen has the max_steps .*expected a number of actions"):
            declared_limit(SimpleNamespace(max_steps=wrong), "kitchen")


@pytest.mark.parametrize(
    ("limit", "typed", "most", "words"),
    [
        (300, None, 300, "at most 300 actions each: the environment's own limit"),
        (
            300,
            200,
            200,
            "at most 200 actions each: --max-steps; the environment's own limit is 300; rates are not",
        ),
        (300, 400, 400, "at most 400 actions each: --max-steps; the environment's own limit is 300"),
        (None, None, MAX_STEPS, "at most 200 actions each: the environment declares no limit of its own"),
        (None, 9, 9, "at most 9 actions each: --max-steps; the environment declares no limit of its own"),
        (20_000, None, 10_000, "at most 10000 actions each: up to the environment's own limit of 20000"),
    ],
)
def test_the_environments_limit_is_the_default_and_another_one_is_said(
    monkeypatch: pytest.MonkeyPatch, limit: int | None, typed: int | None, most: int, words: str
) -> None:
    import reach_env

    monkeypatch.setattr(reach_env.ReachEnv, "max_steps", limit, raising=False)
    source = opened(max_steps=typed)
    assert source.decided()["source"].steps() == most
    assert source.most_steps(source.episodes[0][1]) == most
    assert words in words_of(source)["episodes"]
    assert ("not the benchmark's" in words_of(source)["episodes"]) is bool(limit and typed and typed < limit)


def test_episodes_of_several_limits_end_at_their_own_unless_another_one_is_typed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import reach_env

    monkeypatch.setattr(reach_env, "PerEpisode", PerEpisode, raising=False)
    source = opened(HOME + "PerEpisode")
    assert [row.columns["max_steps"] for row in source.rows(0)] == [280, 280, 520]
    assert source.settings.steps() == 520
    assert "at most 280 to 520 actions each: the environment's own limit" in words_of(source)["episodes"]
    typed = opened(HOME + "PerEpisode", max_steps=300)
    assert "max_steps" not in typed.rows(0)[0].columns
    assert {typed.most_steps(episode) for _, episode in typed.episodes} == {300}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "limit"), [("Registered", 300), ("MadeLate", 300)])
def test_the_limit_of_a_registered_environment_is_found_when_it_is_made_early_or_late(
    name: str, limit: int
) -> None:
    assert opened(REGISTERED + name).settings.limit == limit
    assert opened(REGISTERED + name, rotations=["180"]).settings.limit == limit
    assert opened(REGISTERED + "Registered", options={"name": "Reach-v0"}).settings.limit is None


def player_of(source: EnvironmentSource) -> EnvironmentPlayer:
    return EnvironmentPlayer(source.settings, ("block", "left", "success"), Played(), source.starts)


def test_an_episode_stores_its_limit_and_its_start(monkeypatch: pytest.MonkeyPatch) -> None:
    import reach_env

    monkeypatch.setattr(reach_env.ReachEnv, "max_steps", 7, raising=False)
    source = opened(max_steps=2)
    stage, row = player_of(source), source.rows(0)[0]
    stage.begin(row, film=False)
    ending = stage.advance(np.zeros((5, 7), np.float32))
    assert isinstance(ending, Ending)
    assert (ending.outcome["steps"], ending.outcome["done"], ending.outcome[LIMIT]) == (2, False, 7)
    assert ending.outcome[START] == start_digest(ReachEnv().reset(row.content))


def test_both_rates_are_said_and_that_fewer_actions_than_the_benchmarks_lower_them() -> None:
    ended = {"steps": [90, 200, 200, 300], "done": [True, False, False, False], LIMIT: [300] * 4}
    succeeded = {ONCE: [True, True, False, False], AT_END: [True, False, False, False]}
    rates = EnvironmentSuccess.of(pd.DataFrame(ended | succeeded))
    assert rates is not None
    assert (rates.sr, rates.success_once, rates.stopped) == (0.25, 0.5, 2)
    for words in ("success rate 25% of 4 episodes", "success_once 50%, by any action, as lerobot-eval counts"):
        assert words in rates.sentence
    assert (
        "--max-steps ended 2 of them after 200 actions, and the environment's own limit is 300" in rates.sentence
    )
    complete = {ONCE: [True], AT_END: [True], "steps": [300], "done": [False]}
    full, old = (EnvironmentSuccess.of(pd.DataFrame(complete | limit)) for limit in ({LIMIT: [300]}, {}))
    assert full is not None and old is not None  # noqa: PT018
    assert "--max-steps" not in full.sentence + old.sentence
    assert EnvironmentSuccess.of(pd.DataFrame({"outcome": ["ended"]})) is None


# -- starts -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        (HOME + "Drifting", {}, r"the state \(number [012] by [\d.e-]+\), facts; equal: the picture"),
        pytest.param(
            REGISTERED + "Registered", {"name": "Stubborn-v0"},
            "first reset of a new environment does repeat: its constructor and the number of resets",
            marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_an_episode_that_does_not_repeat_is_refused_before_anything_is_played(
    name: str, options: dict[str, str], words: str
) -> None:
    source = opened(name, options=options)
    with pytest.raises(OwnEnvironmentError, match="set up twice with the seed 0, it starts otherwise") as raised:
        source.rehearse(source.rows(0))
    import re

    assert re.search(words, str(raised.value))
    assert "--accept-nondeterminism" in str(raised.value)
    accepted = opened(name, options=options, accept_nondeterminism=True)
    accepted.rehearse(accepted.rows(0))
    assert "--accept-nondeterminism" in words_of(accepted)["starts"]


def test_a_process_in_which_an_episode_starts_otherwise_ends_the_run() -> None:
    source = opened()
    source.rehearse(source.rows(0))
    stage = player_of(source)
    for row in source.rows(0)[:3]:
        assert isinstance(stage.begin(row, film=False), Observation)
    other = EnvEpisode("reach-00", 5, "Put the cube on the red shape")
    row = Row(0, {**source.rows(0)[0].columns}, other)
    with pytest.raises(
        OtherFramesError, match="'reach-00' starts otherwise than it did when the run was prepared"
    ):
        stage.begin(row, film=False)


def test_a_group_is_what_the_environment_names_and_else_an_episode() -> None:
    assert "the environment names them" in words_of(opened())["groups"]
    source = opened()
    assert "12 in 6 groups" in words_of(source)["episodes"]
    assert source.smaller_groups(source.rows(0)) == f"train --group-by {START} makes a group of each start"
    assert source.smaller_groups(()) == ""


@pytest.mark.slow
def test_seeds_that_start_equally_are_named_in_the_plan() -> None:
    fixed = opened(REGISTERED + "Registered", options={"name": "Fixed-v0"})
    fixed.rehearse(fixed.rows(0))
    assert "starts" in words_of(fixed)
    # The environment names pairs, so that the first two episodes are of one group.
    assert not fixed.starts_are_equal
    fixed = opened(REGISTERED + "Registered", options={"name": "Fixed-v0"}, episodes="0,2")
    fixed.rehearse(fixed.rows(0))
    assert f"train with --group-by {START}" in words_of(fixed)["starts"]


# -- pictures -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rotations", "first", "wrist"),
    [(["180"], 2, 2), (["wrist=90"], 0, 1), (["base=270"], 3, 0), (["180", "wrist=90"], 2, 1), ({"*": 90}, 1, 1)],
)
def test_pictures_of_all_cameras_or_of_one_are_rotated_at_every_step(
    rotations: Any, first: int, wrist: int
) -> None:
    plain, turned = (
        open_environment(EnvironmentSettings(HOME + "TwoCameras", rotations=chosen_rotations))
        for chosen_rotations in ((), rotations)
    )
    episode = next(iter(plain.episodes()))
    for was, now in (
        (plain.reset(episode), turned.reset(episode)),
        (plain.step(np.ones(7, np.float32)), turned.step(np.ones(7, np.float32))),
    ):
        before, after = was.observation, now.observation  # type: ignore[union-attr]
        np.testing.assert_array_equal(after.image, np.rot90(before.image, first))
        np.testing.assert_array_equal(after.cameras["wrist"], np.rot90(before.cameras["wrist"], wrist))
        np.testing.assert_array_equal(after.state, before.state)


def test_a_rotation_of_a_camera_that_no_picture_has_is_refused(pi0_tiny: Any) -> None:
    with pytest.raises(UsageError, match="--rotate front=…: reach_env:ReachEnv has no such camera; it shows base"):
        opened(rotations=["front=180"]).check(pi0_tiny, accept_units=False)


def test_the_check_writes_the_first_pictures_and_says_where_episodes_end(tmp_path: Path) -> None:
    from PIL import Image

    checks = {check.name: check for check in check_environment(HOME + "TwoCameras", tmp_path / "first.png")}
    with Image.open(tmp_path / "first.png") as picture:
        assert picture.size == (96, 48)
    assert checks["episodes_are_listed"].facts == "12 episodes in 6 groups"
    assert "the picture 48 × 48 × 3" in checks["steps_are_whole"].facts
    assert "declares no limit" in checks["steps_are_whole"].facts
