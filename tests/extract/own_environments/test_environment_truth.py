"""Units, order and success of an environment are held to what they mean, and its arrays are copied when taken."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import OwnEnvironmentError, UnitsError
from probe_kit.extract import EnvSource, ExtractSettings, Step, check_environment, prepare
from probe_kit.extract.sources.environment import SUCCESS
from probe_kit.extract.sources.environment_source import EnvironmentPlayer, checked_step, open_environment
from probe_kit.extract.sources.player import Ending
from probe_kit.extract.sources.source import Played
from probe_kit.hooks import Observation
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.runs.layout import AT_END, ONCE
from tests.extract.own_environments.test_contract import EPISODE, SEEN, planned
from tests.support.reach_env import ReachEnv

FACTS = ("block", "left", "success")


def settings(name: str, **given: Any) -> ExtractSettings:
    return ExtractSettings("pi0-tiny", source=EnvSource(f"reach_env:{name}"), env_workers=0, **given)


def played(monkeypatch: pytest.MonkeyPatch, successes: list[bool], steps: int) -> Mapping[str, Any]:
    """The outcome of an episode that says so after each action."""
    after = iter(successes)
    plain = ReachEnv.step

    def step(self: ReachEnv, _action: np.ndarray) -> Step:
        found = plain(self, np.zeros(7, np.float32))
        return Step(found.observation, False, {**found.facts, SUCCESS: next(after)})

    stage = EnvironmentPlayer(EnvSource("reach_env:ReachEnv", max_steps=steps), FACTS, Played())
    monkeypatch.setattr(type(stage._environment), "step", step)
    stage.begin(planned(), film=False)
    ending = stage.advance(np.zeros((steps, 7), np.float32))
    assert isinstance(ending, Ending)
    return ending.outcome


# -- success -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [True, False, 0, 1, 0.0, 1.0, np.True_, np.int64(1), np.float32(0)])
def test_success_is_a_truth_value_however_it_is_typed(value: Any) -> None:
    assert checked_step(Step(SEEN, False, {SUCCESS: value}), EPISODE, "here").facts[SUCCESS] == bool(value)


@pytest.mark.parametrize("value", [0.3, -1, 2, 0.999, np.float32(0.5), "True", None, np.nan, np.ones(1)])
def test_a_part_a_score_and_an_unknown_success_are_refused(value: Any) -> None:
    with pytest.raises(OwnEnvironmentError, match=r"here: the fact 'success' is .*; expected a"):
        checked_step(Step(SEEN, False, {SUCCESS: value}), EPISODE, "here")


@pytest.mark.parametrize(
    ("successes", "outcome", "once", "at_end"),
    [
        ([False, True, False], "failure", True, False),
        ([False, False, True], "success", True, True),
        ([True, True, True], "success", True, True),
        ([False, False, False], "failure", False, False),
    ],
)
def test_the_outcome_is_the_success_at_the_end_and_success_before_it_is_stored_beside(
    monkeypatch: pytest.MonkeyPatch, successes: list[bool], outcome: str, once: bool, at_end: bool
) -> None:
    found = played(monkeypatch, successes, 3)
    assert (found["outcome"], found[ONCE], found[AT_END]) == (outcome, once, at_end)


# -- buffers -----------------------------------------------------------------------------------------------


def test_an_environment_may_write_into_the_arrays_that_it_gave() -> None:
    """Its checks pass, and the first picture of an episode is the first."""
    assert [check.name for check in check_environment("reach_env:Reusing") if check.problem] == []
    picture, state, wrist, lens = (
        np.zeros((4, 4, 3), np.uint8), np.zeros(8, np.float32), np.zeros((4, 4, 3), np.uint8), np.eye(3)
    )  # fmt: skip
    facts = {"count": 0}
    step = Step(Observation(picture, state, EPISODE.instruction, lens, {"wrist": wrist}), False, facts)
    taken = checked_step(step, EPISODE, "here")
    for array in (picture, state, wrist, lens):
        array[...] = 7
    facts["count"] = 7
    seen = taken.observation
    assert not seen.image.any() and not seen.state.any() and not seen.cameras["wrist"].any()  # noqa: PT018
    assert seen.intrinsics is not None and (seen.intrinsics == np.eye(3)).all()  # noqa: PT018
    assert taken.facts == {"count": 0}


@pytest.mark.parametrize("name", ["ReachEnv", "Reusing"])
def test_small_frames_are_the_first_and_the_last_picture(name: str) -> None:
    environment = open_environment(EnvSource("reach_env:ReachEnv"))
    first = environment.reset(planned().content).observation.image  # type: ignore[union-attr]
    stage = EnvironmentPlayer(EnvSource(f"reach_env:{name}", max_steps=3), FACTS, Played("ends"))
    stage.begin(planned(), film=False)
    stage.advance(np.tile(np.float32([0, 0.02, 0, 0, 0, 0, 0]), (3, 1)))
    np.testing.assert_array_equal(stage._first[0][1:], first[1:])


# -- units and names ---------------------------------------------------------------------------------------


def turned(self: ReachEnv, *of: Any) -> Any:
    found = ReachEnv._as_step(self, *of)
    own = found.observation
    return Step(Observation(own.image, own.state * np.float32(57.3), own.instruction), found.done, found.facts)


def test_states_in_other_units_are_refused_of_an_environment_unless_accepted(
    pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch
) -> None:
    import reach_env

    monkeypatch.setattr(reach_env, "Degrees", type("Degrees", (reach_env.ReachEnv,), {"_as_step": turned}), False)
    with pytest.raises(
        UnitsError, match=r"reach_env:Degrees, the state after reset\(\): .*outside the statistics"
    ):
        prepare(settings("Degrees"), model=pi0_tiny)
    one, two = (
        prepare(settings(name, accept_units=name == "Degrees"), model=pi0_tiny) for name in ("Degrees", "ReachEnv")
    )
    assert one.settings.identity() == two.settings.identity(), "accepting units changes no number"


@pytest.mark.slow
def test_a_scene_whose_states_lie_outside_the_statistics_is_refused_unless_accepted(
    pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a checkpoint whose state never moved in one number."""
    chosen = ExtractSettings("pi0-tiny", categories=("color",), items=2, env_workers=0)
    assert prepare(chosen, model=pi0_tiny).plan.episodes

    def still(states: np.ndarray) -> np.ndarray:
        return np.arange(states.shape[1]) * np.ones_like(states) == 3

    monkeypatch.setattr(pi0_tiny, "unusual_states", still)
    with pytest.raises(UnitsError, match=r"the scene .*outside the statistics .* \(number 3 in 100%\); .*-units"):
        prepare(chosen, model=pi0_tiny)
    accepted = ExtractSettings("pi0-tiny", categories=("color",), items=2, env_workers=0, accept_units=True)
    assert prepare(accepted, model=pi0_tiny).plan.episodes


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (("dy", "dx", "dz", "roll", "pitch", "yaw", "grip"), "named in another order: dx, dy, dz"),
        (("a", "dx", "dz", "roll", "pitch", "yaw", "grip"), "named otherwise: dx, dy, dz"),
        (ReachEnv.action_names, None),
        (("x", "y", "z", "roll", "pitch", "yaw", "grip"), None),
        (None, None),
    ],
)
def test_actions_with_names_at_another_place_are_not_executed(
    pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch, own: tuple[str, ...] | None, message: str | None
) -> None:
    monkeypatch.setattr(Pi0, "action_names", property(lambda _self: own))
    if message is None:
        assert prepare(settings("ReachEnv"), model=pi0_tiny).plan.episodes
    else:
        with pytest.raises(OwnEnvironmentError, match=message):
            prepare(settings("ReachEnv"), model=pi0_tiny)
