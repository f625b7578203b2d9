"""What is said of where cubes ended, on outcomes made by hand."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.errors import CaptureChangedActionError, UsageError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene import (
    ClosedLoop,
    ClosedLoopEffect,
    ConditionOutcomes,
    InterventionResult,
    ReplayFiles,
    best_patch_targets,
    load_effects,
    run_intervention,
    stored_image_swaps,
)
from probe_kit.intervene.kinds.interchange import PatchEffect, best_cell
from probe_kit.intervene.open_session import open_session
from probe_kit.intervene.outcomes import arrays_from_bytes
from probe_kit.intervene.replay import CLEAN_RUN, Condition, ConditionContext, ConditionResult
from probe_kit.intervene.rollout import roll_out
from probe_kit.intervene.sessions import ReplaySession
from probe_kit.runs import Run, open_run, verify_run
from probe_kit.suite import Suite
from tests.intervene.answers import measured

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


NAMES = (
    "clean",
    "image_swap",
    "backbone.02|image",
    "backbone.02|image|mean-difference",
    "backbone.02|image|control-1",
)
RIGHT, WRONG, OUT = "correct", "wrong", "oob"


def build_outcomes(episode_outcomes: Sequence[Sequence[str]], names: Sequence[str] = NAMES) -> ConditionOutcomes:
    """episode_outcomes: (K, E), two layouts an item, each item a group of its own."""
    episodes = len(episode_outcomes[0])
    items = np.array([f"color-{number // 2}" for number in range(episodes)])
    shape = len(names), episodes
    return ConditionOutcomes(
        conditions=tuple(names),
        episodes=np.array([f"{item}:{'os'[number % 2]}" for number, item in enumerate(items)]),
        items=items,
        groups=items,
        categories=np.full(episodes, "color"),
        sides=np.array([("left", "right")[number % 2] for number in range(episodes)]),
        displacement=np.zeros(shape),
        max_action_change=np.zeros(shape),
        edit_log=np.zeros((*shape, 5)),
        replay_error=np.zeros(episodes),
        episode_outcomes=np.array(episode_outcomes),
    )


def effects_by_name(
    episode_outcomes: Sequence[Sequence[str]], names: Sequence[str] = NAMES
) -> dict[str, ClosedLoopEffect]:
    return {
        row.name: row for row in ClosedLoop.effects(measured(build_outcomes(episode_outcomes, names), "suite"))
    }


def test_a_choice_that_turns_beyond_its_control_is_confirmed() -> None:
    rows = effects_by_name([[RIGHT] * 16, [WRONG] * 16, [WRONG] * 16, [WRONG] * 14 + [OUT] * 2, [RIGHT] * 16])
    assert [row.finding for row in rows.values()] == ["identity patch", *["confirmed"] * 3, "control"]
    along = rows["backbone.02 image mean-difference"]
    assert (along.net, along.control_net, along.in_zone, along.wrong_in_zone) == (0.875, 0.0, 0.875, 1.0)
    assert (along.gained, along.lost) == (14, 0)
    assert along.p_mcnemar == pytest.approx(2 * 0.5**14)
    assert rows["backbone.02 image"].p_fwe == pytest.approx(1 / 2**8)
    assert rows["clean"].p is None


def test_an_edit_whose_control_does_as_well_is_not_confirmed() -> None:
    rows = effects_by_name([[RIGHT] * 16, [WRONG] * 16, [RIGHT] * 16, [WRONG] * 16, [WRONG] * 16])
    assert rows["backbone.02 image mean-difference"].finding == "not confirmed"
    assert rows["backbone.02 image"].finding == "not confirmed"


def test_a_broken_hand_enters_no_verdict_and_no_family() -> None:
    """Neither as a claim, nor as a control that a claim is compared with."""
    broken = [WRONG] * 7 + [OUT] * 9
    rows = effects_by_name([[RIGHT] * 16, [WRONG] * 16, broken, [WRONG] * 16, broken])
    assert rows["backbone.02 image"].finding == "task disrupted"
    assert rows["backbone.02 image"].p_fwe is None
    assert rows["backbone.02 image"].net > 0
    assert rows["backbone.02 image control-1"].finding == "task disrupted"
    assert rows["backbone.02 image mean-difference"].control_net is None
    assert rows["backbone.02 image mean-difference"].finding == "confirmed"
    half = [WRONG] * 8 + [OUT] * 8
    assert not effects_by_name([[RIGHT] * 16, half], NAMES[:2])["image_swap"].disrupted


def test_falling_out_of_the_zones_is_no_turn() -> None:
    rows = effects_by_name([[RIGHT] * 16, [OUT] * 6 + [RIGHT] * 10], NAMES[:2])
    assert rows["image_swap"].net == 0
    assert rows["image_swap"].correct == 0.625
    assert rows["image_swap"].finding == "not confirmed"


def test_sides_are_of_the_picture_that_is_turned_to() -> None:
    rows = effects_by_name([[RIGHT] * 16, [WRONG, RIGHT] * 8], NAMES[:2])
    assert (rows["image_swap"].net_left, rows["image_swap"].net_right) == (0.0, 1.0)


def test_nothing_in_a_zone_is_no_ratio() -> None:
    rows = effects_by_name([[OUT] * 16, [OUT] * 16], NAMES[:2])
    assert rows["image_swap"].wrong_in_zone is None
    assert not rows["image_swap"].disrupted


def test_shuffled_conditions_are_seldom_confirmed() -> None:
    """Plain and changed outcomes of the same coin: not above one in twenty."""
    draw = np.random.default_rng(0)
    confirmed = [
        effects_by_name(draw.choice([RIGHT, WRONG, OUT], size=(2, 16)).tolist(), NAMES[:2])["image_swap"].finding
        == "confirmed"
        for _ in range(100)
    ]
    assert sum(confirmed) <= 5


def test_stored_answers_come_back_with_outcomes_and_without() -> None:
    outcomes = build_outcomes([[RIGHT, WRONG], [OUT, WRONG]], NAMES[:2])
    again = ConditionOutcomes(**arrays_from_bytes(outcomes.to_bytes()))
    assert again.episode_outcomes is not None
    np.testing.assert_array_equal(again.episode_outcomes, [[RIGHT, WRONG], [OUT, WRONG]])


def patch(name: str, role: str, effect: float, p: float = 0.001) -> PatchEffect:
    return PatchEffect(
        category="color", sites=name, role=role, direction="", coefficient="", is_control=False,
        n_episodes=8, n_items=4,
        effect=effect, effect_ci=(effect, effect), net=0.0, net_ci=(0.0, 0.0), net_left=0.0, net_right=0.0,
        mean_displacement=0.0, control_displacement=None,
        t=0.0, p=p, p_fwe=p, max_action_change=0.0, fires=0, no_op_fires=0, relative_change=0.0,
    )  # fmt: skip


def test_the_best_cell_is_the_last_located_place_in_its_narrowest_role() -> None:
    rows = [
        patch("backbone.00", "all", 1.0), patch("backbone.02", "all", 0.99), patch("backbone.02", "image", 0.9),
        patch("backbone.02", "language", 0.1), patch("backbone.03", "all", 0.0, 1.0),
    ]  # fmt: skip
    cells = [best_cell(rows), best_cell(rows[:2])]
    assert [cell and (cell.sites, cell.role) for cell in cells] == [
        ("backbone.02", "image"),
        ("backbone.02", "all"),
    ]
    assert best_cell(rows[3:]) is None


ASKED = ClosedLoop(
    categories=("color",),
    items=1,
    targets=("backbone.00|all", "backbone.03|all", "expert.01@0-1|all"),
    direction="none",
    controls=0,
)
CALLS = 2


@pytest.fixture(scope="module")
def run(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Two inferences per episode, so that the second one meets what the first one did."""
    from probe_kit.env import SceneSpec

    settings = ExtractSettings(
        "pi0-tiny",
        random_weights=True,
        suite=small_suite.folder,
        items=2,
        categories=("color",),
        execute=2,
        scene=SceneSpec(max_steps=2 * CALLS),
        env_workers=0,
    )
    return extract_run(settings, tmp_path_factory.mktemp("loop") / "run")


@pytest.fixture(scope="module")
def effects(run: Run, source: ReplayFiles, twin: "Policy") -> InterventionResult:
    return run_intervention(run, ASKED, source, load=lambda *_: twin)


def row_of(effects: InterventionResult, sites: str, direction: str = "") -> dict[str, object]:
    (row,) = (row for row in effects.effects if (row.sites, row.direction) == (sites, direction))
    return row.to_json()


@pytest.mark.slow
def test_dose_zero_is_the_stored_run_bit_for_bit_with_every_hook_in_place(effects: InterventionResult) -> None:
    check = effects.certificate["replay"]
    assert check == {
        "episodes": 2, "compared": 2, "equal": 2, "largest_difference": 0.0, "outcomes_equal": 2,
    }  # fmt: skip
    ledger = effects.certificate["edits"]["clean"]
    assert ledger["fires"] == ledger["no_op_fires"] == 2 * CALLS * (2 + 2)
    notes = [note for note in effects.notes if "of items no p" not in note]
    assert [note.partition(".")[0] for note in notes] == ["unread: backbone"], (
        "the end of the backbone is a target"
    )


@pytest.mark.slow
def test_edits_are_in_force_at_every_inference(effects: InterventionResult) -> None:
    edits = effects.certificate["edits"]
    assert edits["backbone.00|all"]["fires"] == 2 * CALLS
    assert edits["expert.01@0-1|all"]["fires"] == 2 * 2 * CALLS
    assert edits["backbone.00|all"]["no_op_fires"] == 0


@pytest.mark.slow
def test_what_nothing_reads_changes_no_episode_and_what_all_reads_is_the_whole_exchange(
    effects: InterventionResult,
) -> None:
    assert row_of(effects, "backbone.03")["max_action_change"] == 0.0
    assert row_of(effects, "backbone.03")["fires"] == 2 * CALLS
    assert row_of(effects, "image_swap")["max_action_change"] > 0  # type: ignore[operator]
    outcomes = effects.outcomes
    np.testing.assert_allclose(outcomes.of("backbone.00|all"), outcomes.of("image_swap"), atol=1e-6)
    np.testing.assert_array_equal(outcomes.episode_outcomes[2], outcomes.episode_outcomes[1])  # type: ignore[index]


@pytest.mark.slow
def test_it_is_stored_apart_from_other_kinds_and_read_back(run: Run, effects: InterventionResult) -> None:
    assert load_effects(run, kind="closed-loop").to_json() == effects.to_json()
    assert load_effects(run).to_csv() == effects.to_csv()
    assert effects.settings["readout"] == "episode"
    assert stored_image_swaps(run) == {}
    assert verify_run(run.path, deep=True).ok
    assert set(effects.table["finding"]) <= {"identity patch", "control", "not confirmed", "task disrupted"}


@pytest.mark.slow
def test_another_outcome_stops_before_anything_is_stored(
    run: Run, effects: InterventionResult, source: ReplayFiles, twin: "Policy", tmp_path: Path
) -> None:
    assert effects
    other = open_run(shutil.copytree(run.path, tmp_path / "run"))
    shutil.rmtree(other.path / "interventions")
    other.episodes["outcome"] = "correct"
    with pytest.raises(CaptureChangedActionError, match="ended oob; the run has correct"):
        run_intervention(other, ASKED, source, load=lambda *_: twin)
    assert not (other.path / "interventions" / effects.key).exists()


@pytest.mark.slow
def test_killed_and_resumed_gives_the_same_bytes(
    recorded_run: Run, source: ReplayFiles, twin: "Policy", tmp_path: Path
) -> None:
    intervention = ClosedLoop(categories=("color",), items=2, targets=("backbone.02|image",))
    copies = [open_run(shutil.copytree(recorded_run.path, tmp_path / name)) for name in ("whole", "killed")]

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_intervention(copies[1], intervention, source, load=lambda *_: twin, progress=stop)
    keys = {run_intervention(copy, intervention, source, load=lambda *_: twin).key for copy in copies}
    (key,) = keys
    for name in ("episodes.npz", "effects.csv", "certificate.json"):
        uninterrupted, killed = ((copy.path / "interventions" / key / name).read_bytes() for copy in copies)
        assert uninterrupted == killed
    edits = load_effects(copies[0], key).certificate["edits"]
    assert {name.rpartition("|")[2] for name in edits} == {"clean", "image", "mean-difference:1", "control-1"}
    assert all(counts["fires"] == 2 * 2 for counts in edits.values())


@pytest.mark.slow
def test_every_inference_has_its_own_state_and_the_pictures_exchanged(
    run: Run, source: ReplayFiles, twin: "Policy"
) -> None:
    observations: list[tuple[Observation, Observation]] = []

    def watch(context: ConditionContext) -> ConditionResult:
        observations.append((context.pair.clean, context.pair.source))  # type: ignore[arg-type]
        return CLEAN_RUN.play(context)

    session: ReplaySession
    with open_session(run, source, lambda *_: twin) as session, session.ready():
        (replay_input, _) = session.pairs(str(run.episodes["item_id"][0]))
        roll_out(session, replay_input, Condition("watched", watch))
    assert len(observations) == CALLS
    assert (observations[0][0].state != observations[1][0].state).any()
    for clean, other in observations:
        np.testing.assert_array_equal(clean.state, other.state)
        assert (clean.image != other.image).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    "intervention",
    [
        lambda: ClosedLoop(targets=()),
        lambda: ClosedLoop(targets=("backbone.02",)),
        lambda: ClosedLoop(targets=("backbone.02|all",), direction="none"),
    ],
)
def test_closed_loop_refuses_impossible_settings(intervention: object) -> None:
    with pytest.raises(UsageError):
        intervention()  # type: ignore[operator]


@pytest.mark.slow
def test_another_rule_and_no_located_place_are_refused(run: Run) -> None:
    with pytest.raises(UsageError, match="by the rule 'box'"):
        ASKED.check_run(run.under("box"))
    with pytest.raises(UsageError, match="--kind interchange"):
        best_patch_targets(run, ("color",))
