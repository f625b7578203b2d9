"""Erasing inside a real network: what is written, what the ledger says, and what the numbers are called."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.intervene import (
    ConceptErasure,
    ConditionOutcomes,
    InterventionResult,
    ReplaySource,
    load_effects,
    run_intervention,
    stored_image_swaps,
)
from probe_kit.intervene.kinds.erase import ErasureEffect, erasure_effects
from probe_kit.runs import Run, open_run, verify_run
from tests.intervene.answers import follower, habit, outcomes_of

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

ASKED = ConceptErasure(categories=("color",), items=6, sites=("backbone.02", "backbone.03"), controls=1)
EPISODES = 12


@pytest.fixture(scope="module")
def effects(copy: Run, source: ReplaySource, twin: "Policy") -> InterventionResult:
    return run_intervention(copy, ASKED, source, load=lambda *_: twin)


def row_of(effects: InterventionResult, place: str, direction: str) -> ErasureEffect:
    (row,) = (row for row in effects.effects if (row.place, row.direction) == (place, direction))
    return row


def test_writing_back_what_is_there_changes_no_action_bit_for_bit(effects: InterventionResult) -> None:
    row = row_of(effects, "backbone.02", "none")
    assert (row.finding, row.max_action_change, row.fires, row.no_op_fires) == (
        "identity patch",
        0.0,
        EPISODES,
        EPISODES,
    )


def test_what_is_erased_is_moved_and_what_nothing_reads_is_not_missed(effects: InterventionResult) -> None:
    for name in ("leace", "control-1"):
        read, unread = (row_of(effects, place, name) for place in ("backbone.02", "backbone.03"))
        assert read.fires == unread.fires == EPISODES
        assert read.no_op_fires == unread.no_op_fires == 0
        assert min(read.relative_change, unread.relative_change) > 0
        assert read.max_action_change > 0
        assert unread.max_action_change == 0.0
        assert unread.net == 0.0


def test_the_certificate_says_what_a_fresh_probe_reads(effects: InterventionResult) -> None:
    said = effects.certificate["probe_accuracy"]
    assert set(said) == {
        f"{place}|image|{what}"
        for place in ("backbone.02", "backbone.03")
        for what in ("none|0", "leace", "control-1")
    }
    assert all(0 <= share <= 1 for one in said.values() for share in one.values())
    row = row_of(effects, "backbone.02", "leace")
    assert (row.probe_accuracy_before, row.probe_accuracy) == tuple(
        said[f"backbone.02|image|{what}"]["color"] for what in ("none|0", "leace")
    )


def test_it_is_stored_apart_from_other_kinds_and_read_back(copy: Run, effects: InterventionResult) -> None:
    assert load_effects(copy, kind="erase").to_json() == effects.to_json()
    assert stored_image_swaps(copy) == {}
    assert verify_run(copy.path, deep=True).ok
    assert "weaker evidence than interchange" in " ".join(effects.notes)
    stored = (copy.path / "interventions" / effects.key / "effects.csv").read_text(encoding="utf-8")
    assert stored.splitlines()[0].split(",")[:4] == ["category", "place", "role", "direction"]


@pytest.mark.slow
def test_killed_and_resumed_gives_the_same_bytes(
    copy: Run, effects: InterventionResult, source: ReplaySource, twin: "Policy", tmp_path: Path
) -> None:
    mine = open_run(shutil.copytree(copy.path, tmp_path / "run"))
    folder = mine.path / "interventions" / effects.key
    shutil.rmtree(folder)

    def stop(done: int, *_: object) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_intervention(mine, ASKED, source, load=lambda *_: twin, progress=stop)
    assert run_intervention(mine, ASKED, source, load=lambda *_: twin).key == effects.key
    for name in ("episodes.npz", "effects.csv", "certificate.json"):
        assert (folder / name).read_bytes() == (copy.path / "interventions" / effects.key / name).read_bytes()


# -- what the numbers are called -------------------------------------------------------------------------------


def erased_answers(own: float, beside: float, base: str = "follower") -> ConditionOutcomes:
    """Actions that keep the share `own` of how far they go, and `beside` under two controls."""
    outcomes = outcomes_of({"color": {"follower": follower, "habit": habit}[base](24)})
    plain = outcomes.of("clean")
    rows = np.array([plain, own * plain, beside * plain, beside * plain])
    place = "backbone.02|image"
    return replace(
        outcomes,
        conditions=("clean", f"{place}|leace", f"{place}|control-1", f"{place}|control-2"),
        displacement=rows,
        max_action_change=np.abs(rows - rows[0]),
        edit_log=np.zeros((4, plain.size, 5)),
    )


@pytest.mark.parametrize(
    ("own", "beside", "base", "finding"),
    [
        (0.1, 0.95, "follower", "effect"),
        (-0.5, 0.9, "follower", "effect"),
        (0.9, 0.95, "follower", "no effect"),
        (0.05, 0.3, "follower", "controls also disrupt"),
        (0.1, 0.95, "habit", "no baseline effect"),
    ],
)
def test_what_is_lost_is_lost_beyond_the_controls(own: float, beside: float, base: str, finding: str) -> None:
    row, *controls = erasure_effects(erased_answers(own, beside, base), "suite")
    assert row.finding == finding
    assert [one.finding for one in controls] == ["control", "control"]
    if finding == "no baseline effect":
        assert row.kept is None
        return
    assert row.kept == pytest.approx(own)
    assert row.control_kept == pytest.approx(beside)
    assert row.p is not None
    # Twelve items with the same sign: the smallest possible p.
    assert row.p == 2.0**-12
    assert row.right == (own > 0)


def test_a_loss_in_one_group_is_no_evidence() -> None:
    outcomes = erased_answers(1.0, 1.0)
    one = outcomes.groups == outcomes.groups[0]
    outcomes.displacement[1] = np.where(one, -outcomes.displacement[0], outcomes.displacement[0])
    row = erasure_effects(outcomes, "suite")[0]
    assert row.net > 0
    assert row.p is not None
    assert row.p >= 0.5


@pytest.mark.parametrize(
    "intervention",
    [
        lambda: ConceptErasure(sites=()),
        lambda: ConceptErasure(sites=("backbone.02",), roles=()),
        lambda: ConceptErasure(sites=("backbone.02",), method="zap"),
        lambda: ConceptErasure(sites=("backbone.02",), method="leace:3"),
    ],
)
def test_what_cannot_be_asked_is_refused(intervention: object) -> None:
    with pytest.raises(UsageError):
        intervention()  # type: ignore[operator]


def test_ways_are_one_key_however_they_are_written() -> None:
    assert ConceptErasure(sites=("backbone.02",), method="inlp") == ConceptErasure(
        sites=("backbone.02",), method="inlp:5"
    )
