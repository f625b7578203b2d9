"""Shadow: conditions are evaluated at every inference of the unedited episode, and not carried out."""

from dataclasses import replace
from math import ceil
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.extract import Run
from probe_kit.intervene import ClosedLoop, Effects, Erase, Follow, Interchange, Source, intervene_on
from probe_kit.intervene.replay.session import open_bench
from probe_kit.intervene.store.settings import key_of, settings_of
from probe_kit.suite import Suite

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

ASKED = Interchange(
    categories=("color",), items=1, sites=("backbone.00", "backbone.03"), roles=("all",), readout="shadow"
)
EPISODES, STEPS = 2, 4


@pytest.fixture(scope="module")
def effects(copy: Run, small_suite: Suite, twin: "Policy") -> Effects:
    return intervene_on(copy, ASKED, Source(small_suite.folder), load=lambda *_: twin)


def test_the_plain_condition_is_the_sum_of_what_the_run_commanded(
    copy: Run, effects: Effects, small_suite: Suite, twin: "Policy"
) -> None:
    assert effects.certificate["replay"]["equal"] == EPISODES
    found = dict(zip(effects.answers.episodes, effects.answers.of("plain"), strict=True))
    with open_bench(copy, Source(small_suite.folder), lambda *_: twin) as bench:
        for row, name in enumerate(copy.episodes["episode_id"]):
            if name not in found:
                continue
            commanded = np.asarray(copy.trajectory(row).commanded, np.float64)
            (question,) = (
                one for one in bench.questions(str(copy.episodes["item_id"][row])) if one.episode_id == name
            )
            end = question.seen.state[:2].astype(np.float64) + commanded[:, :2].sum(axis=0)
            assert found[name] == pytest.approx(bench.across(end), abs=1e-5)


def test_every_call_is_changed_and_nothing_of_it_is_carried_out(copy: Run, effects: Effects) -> None:
    calls = ceil(STEPS / int(copy.settings["execute"]))
    for said in effects.certificate["edits"].values():
        assert said["fires"] == EPISODES * calls
    answers = effects.answers
    assert answers.outcomes is None
    np.testing.assert_allclose(answers.of("backbone.00|all"), answers.of("exchanged"), atol=1e-6)
    assert (answers.of("exchanged") != answers.of("plain")).any()
    assert answers.changed[answers.conditions.index("backbone.03|all")].max() == 0.0
    assert any("Shadow" in note for note in effects.notes)


def test_it_is_another_key_than_the_first_inference(copy: Run) -> None:
    keys = {key_of(settings_of(replace(Follow(items=1), readout=name), copy)) for name in ("chunk", "shadow")}  # type: ignore[arg-type]
    assert len(keys) == 2


@pytest.mark.parametrize(
    "asked",
    [
        lambda: ClosedLoop(cells=("backbone.02|all",), readout="shadow"),
        lambda: Erase(sites=("backbone.02",), readout="shadow"),
        lambda: Follow(readout="glance"),  # type: ignore[arg-type]
    ],
)
def test_what_is_read_elsewhere_has_no_shadow(asked: object) -> None:
    with pytest.raises(UsageError):
        asked()  # type: ignore[operator]
