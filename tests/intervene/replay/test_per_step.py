"""Per-step readout: conditions are evaluated at every inference of the unedited episode, and not executed."""

from dataclasses import replace
from math import ceil
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.intervene import (
    ClosedLoop,
    ConceptErasure,
    ImageSwap,
    Interchange,
    InterventionResult,
    ReplayFiles,
    run_intervention,
)
from probe_kit.intervene.open_session import open_session
from probe_kit.intervene.settings import key_of, settings_of
from probe_kit.runs import Run
from probe_kit.suite import Suite

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

ASKED = Interchange(
    categories=("color",), items=1, sites=("backbone.00", "backbone.03"), roles=("all",), readout="per-step"
)
EPISODES, STEPS = 2, 4


@pytest.fixture(scope="module")
def effects(copy: Run, small_suite: Suite, twin: "Policy") -> InterventionResult:
    return run_intervention(copy, ASKED, ReplayFiles(small_suite.folder), load=lambda *_: twin)


@pytest.mark.slow
def test_the_plain_condition_is_the_sum_of_what_the_run_commanded(
    copy: Run, effects: InterventionResult, small_suite: Suite, twin: "Policy"
) -> None:
    assert effects.certificate["replay"]["equal"] == EPISODES
    clean_by_episode = dict(zip(effects.outcomes.episodes, effects.outcomes.of("clean"), strict=True))
    with open_session(copy, ReplayFiles(small_suite.folder), lambda *_: twin) as session:
        for row, name in enumerate(copy.episodes["episode_id"]):
            if name not in clean_by_episode:
                continue
            commanded = np.asarray(copy.trajectory(row).commanded, np.float64)
            (replay_input,) = (
                pair for pair in session.pairs(str(copy.episodes["item_id"][row])) if pair.episode == name
            )
            end = replay_input.clean.state[:2].astype(np.float64) + commanded[:, :2].sum(axis=0)
            assert clean_by_episode[name] == pytest.approx(session.lateral_offset(end), abs=1e-5)


def test_every_call_is_changed_and_nothing_of_it_is_carried_out(copy: Run, effects: InterventionResult) -> None:
    calls = ceil(STEPS / int(copy.settings["execute"]))
    for counts in effects.certificate["edits"].values():
        assert counts["fires"] == EPISODES * calls
    outcomes = effects.outcomes
    assert outcomes.episode_outcomes is None
    np.testing.assert_allclose(outcomes.of("backbone.00|all"), outcomes.of("image_swap"), atol=1e-6)
    assert (outcomes.of("image_swap") != outcomes.of("clean")).any()
    assert outcomes.max_action_change[outcomes.conditions.index("backbone.03|all")].max() == 0.0
    assert any("teacher-forced" in note for note in effects.notes)


def test_it_is_another_key_than_the_first_inference(copy: Run) -> None:
    keys = {
        key_of(settings_of(replace(ImageSwap(items=1), readout=name), copy))
        for name in ("first-chunk", "per-step")
    }  # type: ignore[arg-type]
    assert len(keys) == 2


@pytest.mark.parametrize(
    "intervention",
    [
        lambda: ClosedLoop(targets=("backbone.02|all",), readout="per-step"),
        lambda: ConceptErasure(sites=("backbone.02",), readout="per-step"),
        lambda: ImageSwap(readout="glance"),  # type: ignore[arg-type]
    ],
)
def test_an_answer_that_is_read_at_another_step_leaves_no_effect_here(intervention: object) -> None:
    with pytest.raises(UsageError):
        intervention()  # type: ignore[operator]
