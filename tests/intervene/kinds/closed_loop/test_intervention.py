"""Closed loop, on a real network and simulator: what is played is the run's, and edits act at every inference."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.errors import CaptureChangedActionError, UsageError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene import (
    ClosedLoop,
    InterventionResult,
    ReplaySource,
    best_patch_targets,
    load_effects,
    run_intervention,
    stored_image_swaps,
)
from probe_kit.intervene.replay import CleanRun
from probe_kit.intervene.rollout import roll_out
from probe_kit.intervene.sessions.opening import open_session
from probe_kit.intervene.sessions.session import ReplaySession
from probe_kit.runs import Run, open_run, verify_run
from probe_kit.suite import Suite

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

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
def effects(run: Run, source: ReplaySource, twin: "Policy") -> InterventionResult:
    return run_intervention(run, ASKED, source, load=lambda *_: twin)


def row_of(effects: InterventionResult, place: str, direction: str = "") -> dict[str, object]:
    (row,) = (row for row in effects.effects if (row.place, row.direction) == (place, direction))
    return row.to_json()


def test_dose_zero_is_the_stored_run_bit_for_bit_with_every_hook_in_place(effects: InterventionResult) -> None:
    check = effects.certificate["replay"]
    assert check == {
        "episodes": 2, "compared": 2, "equal": 2, "largest_difference": 0.0, "outcomes_equal": 2,
    }  # fmt: skip
    said = effects.certificate["edits"]["clean"]
    assert said["fires"] == said["no_op_fires"] == 2 * CALLS * (2 + 2)
    assert [note for note in effects.notes if "of items no p" not in note] == []


def test_edits_are_in_force_at_every_inference(effects: InterventionResult) -> None:
    edits = effects.certificate["edits"]
    assert edits["backbone.00|all"]["fires"] == 2 * CALLS
    assert edits["expert.01@0-1|all"]["fires"] == 2 * 2 * CALLS
    assert edits["backbone.00|all"]["no_op_fires"] == 0


def test_what_nothing_reads_changes_no_episode_and_what_all_reads_is_the_whole_exchange(
    effects: InterventionResult,
) -> None:
    assert row_of(effects, "backbone.03")["max_action_change"] == 0.0
    assert row_of(effects, "backbone.03")["fires"] == 2 * CALLS
    assert row_of(effects, "image_swap")["max_action_change"] > 0  # type: ignore[operator]
    outcomes = effects.outcomes
    np.testing.assert_allclose(outcomes.of("backbone.00|all"), outcomes.of("image_swap"), atol=1e-6)
    np.testing.assert_array_equal(outcomes.episode_outcomes[2], outcomes.episode_outcomes[1])  # type: ignore[index]


def test_it_is_stored_apart_from_other_kinds_and_read_back(run: Run, effects: InterventionResult) -> None:
    assert load_effects(run, kind="closed-loop").to_json() == effects.to_json()
    assert load_effects(run).to_csv() == effects.to_csv()
    assert effects.settings["readout"] == "episode"
    assert stored_image_swaps(run) == {}
    assert verify_run(run.path, deep=True).ok
    assert set(effects.table["finding"]) <= {"identity patch", "control", "not confirmed", "task disrupted"}


def test_another_outcome_stops_before_anything_is_stored(
    run: Run, effects: InterventionResult, source: ReplaySource, twin: "Policy", tmp_path: Path
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
    recorded_run: Run, source: ReplaySource, twin: "Policy", tmp_path: Path
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
        whole, killed = ((copy.path / "interventions" / key / name).read_bytes() for copy in copies)
        assert whole == killed
    edits = load_effects(copies[0], key).certificate["edits"]
    assert {name.rpartition("|")[2] for name in edits} == {"clean", "image", "mean-difference:1", "control-1"}
    assert all(said["fires"] == 2 * 2 for said in edits.values())


def test_every_inference_has_its_own_state_and_the_pictures_exchanged(
    run: Run, source: ReplaySource, twin: "Policy"
) -> None:
    seen: list[tuple[Observation, Observation]] = []

    class Watching(CleanRun):
        def play(self, context):  # type: ignore[no-untyped-def]
            seen.append((context.pair.clean, context.pair.source))
            return super().play(context)

    session: ReplaySession
    with open_session(run, source, lambda *_: twin) as session, session.ready():
        (replay_input, _) = session.pairs(str(run.episodes["item_id"][0]))
        roll_out(session, replay_input, Watching())
    assert len(seen) == CALLS
    assert (seen[0][0].state != seen[1][0].state).any()
    for own, other in seen:
        np.testing.assert_array_equal(own.state, other.state)
        assert (own.image != other.image).any()


@pytest.mark.parametrize(
    "intervention",
    [
        lambda: ClosedLoop(targets=()),
        lambda: ClosedLoop(targets=("backbone.02",)),
        lambda: ClosedLoop(targets=("backbone.02|all",), direction="none"),
    ],
)
def test_what_cannot_be_asked_is_refused(intervention: object) -> None:
    with pytest.raises(UsageError):
        intervention()  # type: ignore[operator]


def test_another_rule_and_no_located_place_are_refused(run: Run) -> None:
    with pytest.raises(UsageError, match="by the rule 'box'"):
        ASKED.categories_in(run.under("box"))
    with pytest.raises(UsageError, match="--kind interchange"):
        best_patch_targets(run, ("color",))
