"""The contract of an environment of one's own: a Gymnasium environment passes, broken ones are named."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import OwnEnvironmentError, UsageError
from probe_kit.extract import EnvEpisode, EnvironmentSettings, Step, check_environment
from probe_kit.extract.sources.environment_source import (
    EnvironmentPlayer,
    checked_step,
    factory_of,
    listed_episodes,
    open_environment,
)
from probe_kit.extract.sources.player import Ending
from probe_kit.extract.sources.source import Played
from probe_kit.hooks import Observation
from probe_kit.runs.plan import Row
from tests.support.reach_env import ReachEnv

HOME = "reach_env:"
FACTS = ("block", "left", "success")
EPISODE = EnvEpisode("one", 3, "open it")
SEEN = Observation(np.zeros((4, 4, 3), np.uint8), np.zeros(8, np.float32), "open it")


def failures(name: str) -> dict[str, str]:
    return {check.name: check.problem for check in check_environment(HOME + name) if not check.passed}


def test_thirty_lines_around_a_gymnasium_environment_keep_the_contract() -> None:
    checks = list(check_environment(HOME + "ReachEnv"))
    assert [check.name for check in checks if check.problem] == []
    assert len(checks) == 7


@pytest.mark.parametrize(
    ("name", "check", "message"),
    [
        ("Nameless", "it_opens", "revision ''; expected a text that changes with its numbers"),
        ("Drifting", "equal_seeds_give_equal_frames", "differs after 0 actions: the state"),
        ("Forgetful", "facts_are_constant", r"has the facts \['block', 'late', 'left', 'success'\]"),
        ("Shrinking", "steps_are_whole", r"step\(\) 2: the state has the shape \(5,\), in reset\(\) \(8,\)"),
        ("Broken", "steps_are_whole", r"step\(\): ZeroDivisionError: the simulator exploded"),
    ],
)
def test_a_broken_promise_is_named(name: str, check: str, message: str) -> None:
    import re

    failed_checks = failures(name)
    assert re.search(message, failed_checks[check])
    if name not in ("Nameless", "Shrinking", "Broken"):
        assert set(failed_checks) == {check}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("absent_module:Kitchen", "there is no module absent_module"),
        (HOME + "Kitchen", "has no class 'Kitchen'"),
        ("kitchen", "expected MODULE:CLASS such as kitchen:Kitchen"),
        ("", "expected MODULE:CLASS"),
    ],
)
def test_a_class_that_is_not_there_is_a_wrong_argument(name: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        factory_of(name)
    with pytest.raises(UsageError, match=message):
        list(check_environment(name))


def test_a_module_of_the_working_folder_is_found_and_its_own_error_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", list(__import__("sys").path))
    (tmp_path / "own_kitchen.py").write_text(
        "from tests.support.reach_env import ReachEnv as Kitchen", encoding="utf-8"
    )
    (tmp_path / "sad_kitchen.py").write_text("import not_installed_simulator", encoding="utf-8")
    assert factory_of("own_kitchen:Kitchen") is ReachEnv
    with pytest.raises(OwnEnvironmentError, match=r"its import: ModuleNotFoundError.*not_installed_simulator"):
        factory_of("sad_kitchen:Kitchen")


# -- episodes -------------------------------------------------------------------------------------------------


class Listed(ReachEnv):
    """Lists what it is given."""

    def __init__(self, listed: list[Any]) -> None:
        super().__init__()
        self._listed = listed

    def episodes(self) -> Any:
        return iter(self._listed)


@pytest.mark.parametrize(
    ("listed", "message"),
    [
        ([], "has no episode"),
        (["a"], "is a str; expected an EnvEpisode"),
        ([EPISODE, EPISODE], "two episodes of the id 'one'"),
        ([EnvEpisode("a\u202eb", 0, "x")], "expected plain text"),
        ([EnvEpisode("a", -1, "x")], "the seed -1"),
        ([EnvEpisode("a", 0.5, "x")], "the seed 0.5"),  # type: ignore[arg-type]
        ([EnvEpisode("a", 0, " ")], "the instruction ' '"),
        ([EnvEpisode("a" * 201, 0, "x")], "more than 200 characters"),
    ],
)
def test_episodes_that_cannot_be_told_apart_or_named_are_refused(listed: list[Any], message: str) -> None:
    with pytest.raises(OwnEnvironmentError, match=message):
        listed_episodes(Listed(listed), EnvironmentSettings("x:Y"))


def test_chosen_episodes_are_those_of_their_indices_and_endless_lists_end() -> None:
    from itertools import count

    class Endless(ReachEnv):
        def episodes(self) -> Any:
            return (EnvEpisode(f"e{number}", number, "x") for number in count())

    episodes = listed_episodes(Endless(), EnvironmentSettings("x:Y", episodes=(5, 2)))
    assert [(number, episode.id) for number, episode in episodes] == [(2, "e2"), (5, "e5")]
    with pytest.raises(UsageError, match="has 12 episodes, counted from 0; asked for 12"):
        listed_episodes(ReachEnv(), EnvironmentSettings("x:Y", episodes=(12,)))


@pytest.mark.parametrize("wrong", [{"max_steps": 0}, {"episodes": ()}, {"episodes": (-1,)}, {"max_steps": 10**6}])
def test_settings_that_no_environment_can_have_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        EnvironmentSettings("x:Y", **wrong)


# -- steps ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, "gave a NoneType; expected a Step"),
        (Step(None), "gave a NoneType"),  # type: ignore[arg-type]
        (Step(Observation(np.zeros((4, 4, 3)), SEEN.state, "open it")), "image is float64"),  # type: ignore[arg-type]
        (Step(Observation(SEEN.image, np.zeros(8), "open it")), "the state is float64"),  # type: ignore[arg-type]
        (Step(Observation(SEEN.image, np.full(8, np.nan, np.float32), "open it")), "the state holds NaN"),
        (Step(Observation(SEEN.image, SEEN.state, "close it")), "expected the same"),
        (Step(SEEN, False, {"x": np.nan}), "the fact 'x' is nan; expected a finite number"),
        (Step(SEEN, False, {"x": "open"}), "the fact 'x' is 'open'"),
        (Step(SEEN, False, {"x\u202e": 1.0}), "a fact has the name 'x.*'; expected plain text"),
    ],
)
def test_steps_that_break_the_contract_are_refused_with_their_place(answer: Any, message: str) -> None:
    with pytest.raises(OwnEnvironmentError, match=message):
        checked_step(answer, EPISODE, "kitchen, step() 3")


def stage(name: str = "ReachEnv", **options: Any) -> EnvironmentPlayer:
    return EnvironmentPlayer(EnvironmentSettings(HOME + name, **options), FACTS, Played("ends", 3))


def planned(seed: int = 3) -> Row:
    """The row of an episode."""
    episode = list(ReachEnv().episodes())[seed]
    columns = {"episode_id": episode.id, "instruction": episode.instruction, "env_episode": seed, "policy_seed": 5}
    return Row(0, columns, episode)


def test_an_episode_ends_with_its_outcome_its_frames_and_the_inputs_of_its_captured_inferences() -> None:
    """Three captured inferences of five, two actions each; the fourth and fifth leave no inputs."""
    played = stage(max_steps=9)
    actions = np.zeros((2, 7), np.float32)
    answer = played.begin(planned(), False)
    states = []
    while isinstance(answer, Observation):
        states.append(answer.state)
        answer = played.advance(actions)
    assert isinstance(answer, Ending)
    assert answer.outcome["outcome"] == "failure"
    assert (answer.outcome["steps"], answer.outcome["done"]) == (8, True)
    assert len(answer.small_frames) == 2
    assert answer.inputs is not None
    np.testing.assert_array_equal(answer.inputs["state"], states[:3])
    assert answer.inputs["action"].shape == (3, 2, 7)
    assert answer.inputs["columns"].shape == (3, 3)
    assert answer.inputs["pixels"].shape == (3, 1, 32, 32, 3)


def test_an_episode_that_reaches_the_block_succeeds_and_one_that_runs_out_of_steps_does_not() -> None:
    played = stage(max_steps=5)
    answer = played.begin(planned(), False)
    target = played._environment._env.block  # type: ignore[attr-defined]
    while isinstance(answer, Observation):
        answer = played.advance(np.array([[0, np.clip(target - answer.state[1], -0.02, 0.02), 0, 0, 0, 0, 0]]))
    assert answer.outcome["outcome"] == "success"  # type: ignore[union-attr]
    answer = played.begin(planned(), False)
    while isinstance(answer, Observation):
        answer = played.advance(np.zeros((1, 7), np.float32))
    assert answer.outcome == {**answer.outcome, "outcome": "failure", "steps": 5, "done": False}  # type: ignore[union-attr]


def test_an_error_of_the_environment_names_its_episode_and_method() -> None:
    played = stage("Broken")
    played.answer("begin", (planned(), False))
    with pytest.raises(OwnEnvironmentError, match=r"step\(\): ZeroDivisionError") as raised:
        played.answer("advance", (np.zeros((5, 7), np.float32),))
    assert raised.value.__notes__ == ["in episode reach-03 ('Put the cube on the blue shape')"]


def test_options_are_arguments_of_the_class() -> None:
    source = EnvironmentSettings(HOME + "ReachEnv", options=["count=4"], episodes="0:4")
    assert len(listed_episodes(open_environment(source), source)) == 4
    with pytest.raises(OwnEnvironmentError, match="its constructor: TypeError"):
        open_environment(EnvironmentSettings(HOME + "ReachEnv", {"colour": "red"}))  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "code"), [pytest.param("ReachEnv", 0, marks=pytest.mark.slow), ("Forgetful", 1)])
def test_the_command_prints_a_line_per_promise_and_exits_with_the_result(
    name: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    import typer

    from probe_kit.extract.inspect_commands import check_environment as command

    run: Callable[..., None] = command
    with pytest.raises(typer.Exit) as ended:
        run(HOME + name, as_json=True)
    assert ended.value.exit_code == code
    report = json.loads(capsys.readouterr().out)
    assert report["passed"] is (code == 0)
    with pytest.raises(typer.Exit):
        run(HOME + name)
    output = capsys.readouterr().out
    assert output.count("passed  ") == 7 - code
    assert ("failed" in output) is bool(code)
