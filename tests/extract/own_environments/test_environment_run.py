"""A Gymnasium environment from `extract --env` to a decoded label, with the embedded policy."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import (
    DiskSpaceError,
    OwnEnvironmentError,
    SettingsMismatchError,
    TooFewGroupsError,
    UnitsError,
    UsageError,
)
from probe_kit.extract import EnvironmentSettings, ExtractSettings, Step, check_environment, prepare
from probe_kit.extract.commands import check_size
from probe_kit.extract.sources.environment import SUCCESS
from probe_kit.extract.sources.environment_source import EnvironmentPlayer, checked_step, open_environment
from probe_kit.extract.sources.player import Ending
from probe_kit.extract.sources.source import Played
from probe_kit.hooks import Observation
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.retention import retention_table
from probe_kit.retention.behaviour import TableRun
from probe_kit.retention.table import _success_notes
from probe_kit.runs import Run, open_run, verify_run
from probe_kit.runs.environment_success import EnvironmentSuccess
from probe_kit.runs.layout import AT_END, ONCE, START
from probe_kit.runs.store import locate
from probe_kit.train import Target, train_probes
from probe_kit.train.builtin_columns import BuiltinColumns, label_frame
from probe_kit.train.problem import warn_of_equal_starts
from probe_kit.train.target_samples import target_samples
from tests.extract.own_environments.test_contract import EPISODE, SEEN, planned
from tests.support.every_checkpoint import WRITERS
from tests.support.made_once import made_once
from tests.support.reach_env import ReachEnv

HOME = "reach_env:"


def settings(name: str = "ReachEnv", **options: Any) -> ExtractSettings:
    source = {"max_steps": 6, **{key: options.pop(key) for key in ("episodes", "max_steps") if key in options}}
    all_options = {"captured_calls": 2, "execute": 3, "env_workers": 0, "batch": 6, **options}
    return ExtractSettings("pi0-tiny", source=EnvironmentSettings(HOME + name, **source), **all_options)


@pytest.fixture(scope="session")
def played(pi0_tiny: Pi0, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Twelve episodes in six groups, two inferences each."""

    def make(folder: Path) -> None:
        prepare(settings(), model=pi0_tiny).run(folder / "run")

    return open_run(made_once(tmp_path_factory, "played", make) / "run")


def test_a_run_holds_outcomes_states_actions_and_facts_of_the_environment(played: Run) -> None:
    assert verify_run(played.path, deep=True).ok
    assert played.suite == f"{HOME}ReachEnv@reach 1"
    assert set(played.episodes["outcome"]) <= {"success", "failure"}
    assert played.episodes["group_id"].nunique() == 6
    assert played.inputs is not None
    assert played.inputs.columns == ("block", "left", "success")
    assert played.inputs.read("action").shape == (12, 2, 3, 7)
    assert list(played.control_steps[0]) == [0, 3]
    states = played.inputs.read("state")
    moved = np.abs(states[:, 1, :3] - states[:, 0, :3])
    executed = played.inputs.read("action")[:, 0, :, :3]
    np.testing.assert_allclose(moved, np.abs(np.clip(executed, -0.02, 0.02).sum(axis=1)), atol=1e-5)
    assert played.certificate["hooks_on_equals_hooks_off"]


class Stateless(ReachEnv):
    """The same pictures without a state."""

    def _as_step(self, observation: dict[str, Any], done: bool = False, success: bool = False) -> Step:
        step = super()._as_step(observation, done, success)
        return replace(step, observation=replace(step.observation, state=np.zeros(0, np.float32)))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model put out tokens that name no action")
def test_an_environment_without_a_state_is_stored_without_one(tmp_path: Path) -> None:
    """Zarr has no arrays of length 0."""
    source = EnvironmentSettings(f"{__name__}:{Stateless.__name__}", max_steps=2, episodes="0:2")
    checkpoint, options = WRITERS["openvla"][0](tmp_path / "openvla"), WRITERS["openvla"][1]
    stateless_settings = ExtractSettings(
        "openvla", checkpoint=str(checkpoint), options=options, source=source, env_workers=0
    )
    prepare(stateless_settings).run(tmp_path / "run")
    run = open_run(tmp_path / "run")
    assert verify_run(run.path, deep=True).ok
    assert run.inputs is not None
    assert "state" not in run.inputs.kinds
    assert not any(name.startswith("env.state") for name in BuiltinColumns(run).names)
    assert label_frame(run)["env.left"].notna().all()


@pytest.mark.slow
def test_facts_are_labels_and_a_run_without_sides_refuses_them(played: Run, tmp_path: Path) -> None:
    table = label_frame(played)
    assert {"control_step", "instruction", "env.block", "env.left", "env.state.0", "env.action.dx"} <= set(table)
    assert not [name for name in table if str(name).startswith(("sim.", "item.", "dataset."))]
    file = tmp_path / "labels.csv"
    table.assign(away=table["env.block"] - table["env.state.1"]).to_csv(file, index=False)
    labels = Target.read(file, "away")
    results = train_probes(played, target=labels, permutations=9, controls=("state", "instruction"))
    assert results.settings.task == "continuous"
    assert len(set(results.curves["all", "mean"].groups)) == 6
    assert np.isfinite(results.scores["score"]).all()
    assert Target.of_run(played, "env.block").task == "continuous"
    for target in (Target.of_run(played, "env.left"), Target.read(file, "env.left")):
        assert (target.task, target.coded.classes) == ("binary", ("False", "True")), "a fact that is true or false"
    with pytest.raises(UsageError, match=r"plays an environment of your own .* a retention table is not possible"):
        retention_table([played])
    with pytest.raises(UsageError, match=r"no column env\.absent; there are: env\.block"):
        Target.of_run(played, "env.absent")


@pytest.mark.slow
def test_facts_of_a_run_that_captured_the_first_inference_alone_are_missed_with_the_way_to_get_them(
    pi0_tiny: Pi0, tmp_path: Path
) -> None:
    late = settings("Late", captured_calls=1, episodes="0:2")
    first = prepare(late, model=pi0_tiny).run(tmp_path / "run")
    with pytest.raises(UsageError, match=r"first inferences were captured\. Return .* --captured-calls all"):
        Target.of_run(first, "env.left")


def with_episodes(run: Run, monkeypatch: pytest.MonkeyPatch, **columns: Any) -> None:
    monkeypatch.setitem(vars(run), "episodes", run.episodes.assign(**columns))


def test_a_start_is_a_group_where_a_user_asks_for_it(played: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever groups the environment names; episodes that start equally stay together."""
    left_target = Target.of_run(played, "env.left")
    for column in ("episode_id", "env_seed", START):
        by_column = Target.of_run(played, "env.left", group_by=column)
        assert len(set(target_samples(played, by_column, None, 0, 1).groups)) == 12
    with_episodes(played, monkeypatch, group_id="one")
    with pytest.raises(
        TooFewGroupsError, match=rf"1 groups \(group_id\) .* --group-by {START}, which has 12 groups"
    ):
        train_probes(played, target=left_target, permutations=9)
    by_start = Target.of_run(played, "env.left", group_by=START)
    assert len(set(target_samples(played, by_start, None, 0, 1).groups)) == 12
    with_episodes(played, monkeypatch, **{START: [f"s{row // 4}" for row in range(12)]})
    assert len(set(target_samples(played, by_start, None, 0, 1).groups)) == 3
    by_episode = Target.of_run(played, "env.left", group_by="episode_id")
    with pytest.raises(
        UsageError, match=rf"episodes that start with the same observation.*Give --group-by {START}"
    ):
        target_samples(played, by_episode, None, 0, 1)
    with pytest.raises(TooFewGroupsError, match=r"Label episodes of other groups$"):
        train_probes(played, target=left_target, permutations=9)


def test_groups_that_start_equally_are_named_before_probes_are_fitted(
    played: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    left_target = Target.of_run(played, "env.left")
    with_episodes(played, monkeypatch, **{START: [f"s{row % 10}" for row in range(12)]})
    samples = target_samples(played, left_target, None, 0, 1)
    with pytest.warns(UserWarning, match=rf"4 groups start .* as another one.*--group-by {START}: .* 10 in all"):
        warn_of_equal_starts("left", played, left_target, samples)


@pytest.mark.parametrize("output_kind", ["table", "run show", "run show as JSON"])
def test_both_rates_stand_where_a_rate_is_printed(
    played: Run, output_kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from typer.testing import CliRunner

    from probe_kit.cli import app

    with_episodes(played, monkeypatch, limit=300)
    sentence = EnvironmentSuccess.of(played.episodes)
    assert sentence is not None
    assert "the environment's own limit is 300: both rates may be too low" in sentence.sentence
    if output_kind == "table":
        notes = list(_success_notes([TableRun.of(played)]))
        assert notes == [f"{played.label}: {sentence.sentence}."]
    elif output_kind == "run show as JSON":
        result = CliRunner().invoke(app, ["run", "show", str(played.path), "--json"])
        assert json.loads(result.stdout)["success"]["success_once"] == sentence.success_once
    else:
        result = CliRunner().invoke(app, ["run", "show", str(played.path)])
        assert "success_once" in result.stdout


def check_equal(some: Run, played: Run, rows: list[int]) -> None:
    """Batches of another size differ by rounding."""
    for name in some.streams:
        for ours, row in enumerate(rows):
            np.testing.assert_allclose(some.rows(name)[ours], played.rows(name)[row], atol=1e-4)


@pytest.mark.slow
def test_the_activations_of_an_episode_do_not_depend_on_which_others_are_played(
    played: Run, pi0_tiny: Pi0, tmp_path: Path
) -> None:
    """Alone, and as the beginning of a run that grows."""
    some = prepare(settings(episodes=(3,), batch=1), model=pi0_tiny).run(tmp_path / "run")
    check_equal(some, played, [3])
    grown = prepare(settings(episodes=(1, 3), batch=1), model=pi0_tiny).run(tmp_path / "run")
    assert list(grown.episodes["episode_id"]) == ["reach-01", "reach-03"]
    shorter = settings(episodes=(1,), max_steps=5)
    with pytest.raises(SettingsMismatchError, match=r"environment\.max_steps"):
        prepare(shorter, model=pi0_tiny).run(tmp_path / "run")


@pytest.mark.slow
def test_an_environment_is_played_in_child_processes_with_the_same_numbers(
    played: Run, pi0_tiny: Pi0, tmp_path: Path
) -> None:
    some = prepare(settings(episodes=(3, 1), batch=1, env_workers=2), model=pi0_tiny).run(tmp_path / "run")
    check_equal(some, played, [1, 3])


def test_extract_refuses_an_environment_that_does_not_fit_the_model_before_it_writes(pi0_tiny: Pi0) -> None:
    with pytest.raises(OwnEnvironmentError, match=r"takes 8 numbers as an action .* embedded predicts 7"):
        prepare(settings("Wide"), model=pi0_tiny)
    with pytest.raises(UsageError, match="--execute 17: pi0-tiny gives 16 actions"):
        prepare(settings(execute=17), model=pi0_tiny)
    with pytest.raises(UsageError, match="--no-act does not apply with --env"):
        prepare(settings(capture_only=True), model=pi0_tiny)
    with pytest.raises(UsageError, match="expert is scripted"):
        prepare(settings().changed(model="expert"))


@pytest.mark.slow
def test_an_environment_that_fails_costs_its_episode_and_says_where(pi0_tiny: Pi0, tmp_path: Path) -> None:
    from probe_kit.errors import EpisodesFailedError

    with pytest.raises(EpisodesFailedError) as failed:
        prepare(settings("Broken", episodes=(0, 1)), model=pi0_tiny).run(tmp_path / "run")
    assert "ZeroDivisionError: the simulator exploded" in failed.value.__notes__[0]


def test_options_of_scenes_and_recordings_are_refused_with_an_environment() -> None:
    options = {"model": "pi0-tiny", "env": HOME + "ReachEnv"}
    with pytest.raises(UsageError, match="--light-level does not apply with --env"):
        ExtractSettings.of_command({**options, "light_level": 0.7})
    with pytest.raises(UsageError, match="--select does not apply with --env"):
        ExtractSettings.of_command({**options, "select": "every:2"})
    with pytest.raises(UsageError, match="2 sources"):
        ExtractSettings.of_command({**options, "dataset": "kitchen"})
    with pytest.raises(UsageError, match="--env-option is for environments; give --env"):
        ExtractSettings.of_command({"model": "pi0-tiny", "env_option": ["a=1"]})
    typed = ExtractSettings.of_command(
        {**options, "episodes": "0:2", "max_steps": 9, "no_pixels": False, "captured_calls": "all"}
    )
    assert typed.source == EnvironmentSettings(HOME + "ReachEnv", episodes=(0, 1), max_steps=9, pixels=False)
    assert typed.most_inferences(4) == 3


@pytest.mark.slow
def test_a_run_of_more_than_64_gb_begins_with_yes_only(tmp_path: Path) -> None:
    """30,000 episodes of the released pi0, planned without its weights."""
    source = EnvironmentSettings(HOME + "ReachEnv", {"count": "30000"})  # type: ignore[arg-type]
    planned = prepare(ExtractSettings("pi0", source=source, captured_calls=8), fetch=False)
    location = locate(tmp_path / "run")
    with pytest.raises(DiskSpaceError, match=r"would take up to .* TB; more than 64\.0 GB is written with --yes"):
        check_size(planned, location, agreed=False)
    check_size(planned, location, agreed=True)
    few = EnvironmentSettings(HOME + "ReachEnv", {"count": "12"})  # type: ignore[arg-type]
    check_size(prepare(ExtractSettings("pi0", source=few), fetch=False), location, agreed=False)


FACTS = ("block", "left", "success")


def settings_of(name: str, **options: Any) -> ExtractSettings:
    return ExtractSettings("pi0-tiny", source=EnvironmentSettings(f"reach_env:{name}"), env_workers=0, **options)


def outcome_of(monkeypatch: pytest.MonkeyPatch, successes: list[bool], steps: int) -> Mapping[str, Any]:
    """The outcome of an episode that says so after each action."""
    after = iter(successes)
    plain = ReachEnv.step

    def step(self: ReachEnv, _action: np.ndarray) -> Step:
        plain_step = plain(self, np.zeros(7, np.float32))
        return Step(plain_step.observation, False, {**plain_step.facts, SUCCESS: next(after)})

    stage = EnvironmentPlayer(EnvironmentSettings("reach_env:ReachEnv", max_steps=steps), FACTS, Played())
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
    finished = outcome_of(monkeypatch, successes, 3)
    assert (finished["outcome"], finished[ONCE], finished[AT_END]) == (outcome, once, at_end)


# -- buffers -----------------------------------------------------------------------------------------------


def test_an_environment_may_write_into_the_arrays_that_it_gave() -> None:
    """Its checks pass, and the first picture of an episode is the first."""
    assert [check.name for check in check_environment("reach_env:Reusing") if check.problem] == []
    picture, state, wrist, lens = (
        np.zeros((4, 4, 3), np.uint8), np.zeros(8, np.float32), np.zeros((4, 4, 3), np.uint8), np.eye(3)
    )  # fmt: skip
    facts = {"count": 0}
    step = Step(Observation(picture, state, EPISODE.instruction, lens, {"wrist": wrist}), False, facts)
    checked = checked_step(step, EPISODE, "here")
    for array in (picture, state, wrist, lens):
        array[...] = 7
    facts["count"] = 7
    observation = checked.observation
    assert not observation.image.any() and not observation.state.any() and not observation.cameras["wrist"].any()  # noqa: PT018
    assert observation.intrinsics is not None and (observation.intrinsics == np.eye(3)).all()  # noqa: PT018
    assert checked.facts == {"count": 0}


@pytest.mark.parametrize("name", ["ReachEnv", "Reusing"])
def test_small_frames_are_the_first_and_the_last_picture(name: str) -> None:
    environment = open_environment(EnvironmentSettings("reach_env:ReachEnv"))
    first = environment.reset(planned().content).observation.image  # type: ignore[union-attr]
    stage = EnvironmentPlayer(EnvironmentSettings(f"reach_env:{name}", max_steps=3), FACTS, Played("ends"))
    stage.begin(planned(), film=False)
    stage.advance(np.tile(np.float32([0, 0.02, 0, 0, 0, 0, 0]), (3, 1)))
    np.testing.assert_array_equal(stage._first[0][1:], first[1:])


# -- units and names ---------------------------------------------------------------------------------------


def multiplied(factor: float) -> type[ReachEnv]:
    """The environment whose states are all multiplied."""

    def as_step(self: ReachEnv, *of: Any) -> Step:
        step = ReachEnv._as_step(self, *of)
        observation = step.observation
        return replace(step, observation=replace(observation, state=observation.state * np.float32(factor)))

    return type("Degrees", (ReachEnv,), {"_as_step": as_step})


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (57.3, "57.3 times larger than in training, as degrees for radians"),
        pytest.param(1 / 57.3, "times smaller than in training", marks=pytest.mark.slow),
    ],
)
def test_states_in_other_units_are_refused_of_an_environment_unless_accepted(
    pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch, factor: float, words: str
) -> None:
    import reach_env

    monkeypatch.setattr(reach_env, "Degrees", multiplied(factor), False)
    with pytest.raises(UnitsError, match=rf"reach_env:Degrees, the state after reset\(\): .*{words}"):
        prepare(settings_of("Degrees"), model=pi0_tiny)
    accepted = prepare(settings_of("Degrees", accept_units=True), model=pi0_tiny)
    assert words in accepted.plan.selection["units"]["state units"]["misfits"]
    first, two = (
        prepare(settings_of(name, accept_units=name == "Degrees"), model=pi0_tiny)
        for name in ("Degrees", "ReachEnv")
    )
    assert first.settings.identity() == two.settings.identity(), "accepting units changes no number"


@pytest.mark.slow
def test_a_scene_whose_states_lie_outside_the_statistics_is_refused_unless_accepted(
    pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a checkpoint whose state never moved in one number."""
    scene_settings = ExtractSettings("pi0-tiny", categories=("color",), items=2, env_workers=0)
    assert prepare(scene_settings, model=pi0_tiny).plan.episodes

    moved = pi0_tiny.state_statistics
    assert moved is not None
    deviations = np.where(np.arange(moved.width) == 3, 0, moved.level("std"))
    still = replace(moved, values={**moved.values, "std": deviations})
    monkeypatch.setattr(Pi0, "state_statistics", still)
    with pytest.raises(UnitsError, match=r"the scene .*: number 3 lies outside the statistics in 100%.*-units"):
        prepare(scene_settings, model=pi0_tiny)
    accepted = ExtractSettings("pi0-tiny", categories=("color",), items=2, env_workers=0, accept_units=True)
    assert prepare(accepted, model=pi0_tiny).plan.episodes


@pytest.mark.parametrize(
    ("action_names", "message"),
    [
        (("dy", "dx", "dz", "roll", "pitch", "yaw", "grip"), "named in another order: dx, dy, dz"),
        (("a", "dx", "dz", "roll", "pitch", "yaw", "grip"), "named otherwise: dx, dy, dz"),
        (ReachEnv.action_names, None),
        (("x", "y", "z", "roll", "pitch", "yaw", "grip"), None),
        (None, None),
    ],
)
def test_actions_with_names_at_another_place_are_not_executed(
    pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch, action_names: tuple[str, ...] | None, message: str | None
) -> None:
    monkeypatch.setattr(Pi0, "action_names", property(lambda _self: action_names))
    if message is None:
        assert prepare(settings_of("ReachEnv"), model=pi0_tiny).plan.episodes
    else:
        with pytest.raises(OwnEnvironmentError, match=message):
            prepare(settings_of("ReachEnv"), model=pi0_tiny)
