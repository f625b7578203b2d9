"""Erasing inside a real network: what is written, what the ledger says, and what the numbers are called."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.extract import Run, open_run, verify_run
from probe_kit.intervene import Answers, Effects, Erase, Source, intervene_on, load_effects, stored_following
from probe_kit.intervene.kinds.erase.effects import Erasing, erased
from tests.intervene.answers import answers_of, follower, habit

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

ASKED = Erase(categories=("color",), items=6, sites=("backbone.02", "backbone.03"), controls=1)
EPISODES = 12


@pytest.fixture(scope="module")
def effects(copy: Run, source: Source, twin: "Policy") -> Effects:
    return intervene_on(copy, ASKED, source, load=lambda *_: twin)


def row_of(effects: Effects, place: str, direction: str) -> Erasing:
    (row,) = (row for row in effects.erased if (row.place, row.direction) == (place, direction))
    return row


def test_writing_back_what_is_there_changes_no_action_bit_for_bit(effects: Effects) -> None:
    row = row_of(effects, "backbone.02", "none")
    assert (row.finding, row.changed, row.fires, row.still) == ("dose 0", 0.0, EPISODES, EPISODES)


def test_what_is_erased_is_moved_and_what_nothing_reads_is_not_missed(effects: Effects) -> None:
    for name in ("leace", "control-1"):
        read, unread = (row_of(effects, place, name) for place in ("backbone.02", "backbone.03"))
        assert read.fires == unread.fires == EPISODES
        assert read.still == unread.still == 0
        assert min(read.norm_ratio, unread.norm_ratio) > 0
        assert read.changed > 0
        assert unread.changed == 0.0
        assert unread.net == 0.0


def test_the_certificate_says_what_a_fresh_probe_reads(effects: Effects) -> None:
    said = effects.certificate["readable"]
    assert set(said) == {
        f"{place}|image|{what}"
        for place in ("backbone.02", "backbone.03")
        for what in ("none|0", "leace", "control-1")
    }
    assert all(0 <= share <= 1 for one in said.values() for share in one.values())
    row = row_of(effects, "backbone.02", "leace")
    assert (row.readable_before, row.readable) == tuple(
        said[f"backbone.02|image|{what}"]["color"] for what in ("none|0", "leace")
    )


def test_it_is_stored_apart_from_other_kinds_and_read_back(copy: Run, effects: Effects) -> None:
    assert load_effects(copy, kind="erase").to_json() == effects.to_json()
    assert stored_following(copy) == {}
    assert verify_run(copy.path, deep=True).ok
    assert effects.changes == effects.rows == []
    assert "says less than exchanging" in " ".join(effects.notes)
    stored = (copy.path / "interventions" / effects.key / "effects.csv").read_text(encoding="utf-8")
    assert stored.splitlines()[0].split(",")[:4] == ["category", "place", "role", "direction"]


@pytest.mark.slow
def test_killed_and_resumed_gives_the_same_bytes(
    copy: Run, effects: Effects, source: Source, twin: "Policy", tmp_path: Path
) -> None:
    mine = open_run(shutil.copytree(copy.path, tmp_path / "run"))
    folder = mine.path / "interventions" / effects.key
    shutil.rmtree(folder)

    def stop(done: int, *_: object) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        intervene_on(mine, ASKED, source, load=lambda *_: twin, progress=stop)
    assert intervene_on(mine, ASKED, source, load=lambda *_: twin).key == effects.key
    for name in ("episodes.npz", "effects.csv", "certificate.json"):
        assert (folder / name).read_bytes() == (copy.path / "interventions" / effects.key / name).read_bytes()


# -- what the numbers are called -------------------------------------------------------------------------------


def erased_answers(own: float, beside: float, base: str = "follower") -> Answers:
    """Actions that keep the share `own` of how far they go, and `beside` under two controls."""
    answers = answers_of({"color": {"follower": follower, "habit": habit}[base](24)})
    plain = answers.of("plain")
    rows = np.array([plain, own * plain, beside * plain, beside * plain])
    place = "backbone.02|image"
    return replace(
        answers,
        conditions=("plain", f"{place}|leace", f"{place}|control-1", f"{place}|control-2"),
        lateral=rows,
        changed=np.abs(rows - rows[0]),
        ledger=np.zeros((4, plain.size, 5)),
    )


@pytest.mark.parametrize(
    ("own", "beside", "base", "finding"),
    [
        (0.1, 0.95, "follower", "lost"),
        (-0.5, 0.9, "follower", "lost"),
        (0.9, 0.95, "follower", "kept"),
        (0.05, 0.3, "follower", "controls break too"),
        (0.1, 0.95, "habit", "nothing to lose"),
    ],
)
def test_what_is_lost_is_lost_beyond_the_controls(own: float, beside: float, base: str, finding: str) -> None:
    row, *controls = erased(erased_answers(own, beside, base), "suite")
    assert row.finding == finding
    assert [one.finding for one in controls] == ["control", "control"]
    if finding == "nothing to lose":
        assert row.kept is None
        return
    assert row.kept == pytest.approx(own)
    assert row.control_kept == pytest.approx(beside)
    assert row.p is not None
    # Twelve items, all the same way: the smallest there can be.
    assert row.p == 2.0**-12
    assert row.right == (own > 0)


def test_a_loss_in_one_group_is_no_evidence() -> None:
    answers = erased_answers(1.0, 1.0)
    one = answers.groups == answers.groups[0]
    answers.lateral[1] = np.where(one, -answers.lateral[0], answers.lateral[0])
    row = erased(answers, "suite")[0]
    assert row.net > 0
    assert row.p is not None
    assert row.p >= 0.5


@pytest.mark.parametrize(
    "asked",
    [
        lambda: Erase(sites=()),
        lambda: Erase(sites=("backbone.02",), roles=()),
        lambda: Erase(sites=("backbone.02",), method="zap"),
        lambda: Erase(sites=("backbone.02",), method="leace:3"),
    ],
)
def test_what_cannot_be_asked_is_refused(asked: object) -> None:
    with pytest.raises(UsageError):
        asked()  # type: ignore[operator]


def test_ways_are_one_key_however_they_are_written() -> None:
    assert Erase(sites=("backbone.02",), method="inlp") == Erase(sites=("backbone.02",), method="inlp:5")
