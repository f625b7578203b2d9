"""Words as donors, what one step owes to them, and the memory as a place: on a real run of the random twin."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UnknownSiteError, UnsupportedInterventionError, UsageError
from probe_kit.extract import Run
from probe_kit.intervene import Effects, Interchange, Source, Words, intervene_on, load_effects
from probe_kit.intervene.edits.sites import places, roles_of, token_mask
from probe_kit.intervene.kinds.instruction_swap.effects import sensitivity
from probe_kit.intervene.kinds.instruction_swap.intervention import words_of_twin
from probe_kit.intervene.replay.session import Bench
from probe_kit.intervene.store.answers import Answers

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


@pytest.fixture(scope="module")
def worded(copy: Run, source: Source, twin: "Policy") -> Effects:
    return intervene_on(copy, Words(categories=("color",), items=2), source, load=lambda *_: twin)


# -- words ---------------------------------------------------------------------------------------------------


def test_an_item_asked_in_its_twins_words_does_what_its_twin_does(bench: Bench, worded: Effects) -> None:
    """By hand: the same picture, state and noise, and the words of the item that asks for the other one."""
    answers = worded.answers
    for question in bench.questions(answers.items[0]):
        row = list(answers.episodes).index(question.episode_id)
        words = bench.twins[question.item_id].instruction
        assert words_of_twin(bench, question.item_id, question.layout) == words != question.seen.instruction
        chunk = bench.act(replace(question.seen, instruction=words), question.seed)
        assert answers.of("exchanged")[row] == pytest.approx(bench.lateral(chunk, question.seen), abs=0)


def test_four_inferences_per_episode_tell_words_from_pictures_and_noise(copy: Run, worded: Effects) -> None:
    assert worded.answers.conditions == ("plain", "exchanged", "pictures", "noise")
    assert worded.certificate["items"] == {"asked": 2, "played": 2}
    assert worded.certificate["replay"]["equal"] == 4
    (line,) = worded.table.to_dict("records")
    assert line["category"] == "color"
    assert line["words_changed"] == line["pictures_changed"] == 1.0
    assert min(line["words"], line["pictures"], line["noise"]) > 0
    assert worded.changes == []
    assert load_effects(copy, kind="words").to_csv() == worded.to_csv()
    assert "Is the question read?" in str(worded.to_rich().title)


def test_a_policy_that_is_deaf_is_told_from_one_that_is_blind(worded: Effects) -> None:
    answers = worded.answers
    moved = np.zeros_like(answers.lateral)
    moved[2] = 0.07
    deaf = replace(answers, lateral=moved, changed=np.abs(moved))
    (row,) = sensitivity(deaf)
    assert (row.words, row.pictures, row.noise) == (0.0, 0.07, 0.0)
    assert (row.words_changed, row.pictures_changed) == (0.0, 1.0)
    assert sensitivity(_without_words(answers)) == []


def _without_words(answers: Answers) -> Answers:
    return replace(
        answers, conditions=("plain", "exchanged"), lateral=answers.lateral[:2], changed=answers.changed[:2]
    )


def test_items_without_a_twin_are_passed_over_and_counted(bench: Bench, worded: Effects) -> None:
    alone, paired = str(worded.answers.items[0]), str(worded.answers.items[-1])
    bench.twins = {name: twin for name, twin in bench.twins.items() if name != alone}
    assert Words().playable(bench, [alone, paired]) == [paired]
    with pytest.raises(UsageError, match="has a twin in its suite"):
        Words().playable(bench, [alone])
    passed = replace(worded, certificate={**worded.certificate, "items": {"asked": 2, "played": 1}})
    assert passed.notes[0] == "1 of 2 items have no twin and were passed over."


def test_a_family_whose_inference_is_one_action_is_marked(worded: Effects) -> None:
    shadow = {**worded.certificate, "supported": {"readout": "shadow"}}
    for certificate, is_said in ((worded.certificate, False), (shadow, True)):
        notes = replace(worded, certificate=certificate).notes
        assert any("one action in greedy bins" in note for note in notes) is is_said


# -- memory --------------------------------------------------------------------------------------------------


def test_what_every_block_hands_over_is_a_place_and_all_of_it_is_the_exchange(
    copy: Run, source: Source, twin: "Policy"
) -> None:
    asked = Interchange(categories=("color",), items=1, sites=("memory.*",), roles=("all", "image", "language"))
    effects = intervene_on(copy, asked, source, load=lambda *_: twin)
    assert twin.memory is not None
    blocks = twin.memory.layers - 1
    assert {row.place for row in effects.changes} == {f"memory.{block:02d}" for block in range(blocks)}
    for name, said in effects.certificate["edits"].items():
        assert said["fires"] == 2 * 2, name  # keys and values, in two episodes
    words = effects.certificate["edits"]["memory.00|language"]
    assert (words["still"], words["largest_change"]) == (4.0, 0.0)  # block 0's own words have seen no picture yet
    assert effects.certificate["edits"]["memory.00|image"]["largest_change"] > 0


def test_a_memory_has_the_backbones_roles_and_no_layer_behind_its_last_block(bench: Bench, copy: Run) -> None:
    (question, _) = bench.questions(str(copy.episodes["item_id"][0]))
    mask = token_mask(bench.policy, question.seen, "memory", "image")
    np.testing.assert_array_equal(mask, token_mask(bench.policy, question.seen, "backbone", "image"))
    assert roles_of(bench.policy, "memory", ("all", "image", "state")) == ["all", "image"]
    (place,) = places("memory.01", bench.policy)
    assert [str(site) for site in place.sites] == ["memory.01.keys", "memory.01.values"]
    assert bench.policy.memory is not None
    for wrong in (f"memory.{bench.policy.memory.layers - 1:02d}", "memory.00@1"):
        with pytest.raises(UnknownSiteError):
            places(wrong, bench.policy)


def test_a_family_without_a_memory_is_refused_before_anything_is_loaded(
    copy: Run, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(copy), "model", "internvla-m1")

    def load(*_: object) -> "Policy":
        raise AssertionError("it is refused before")

    with pytest.raises(UnsupportedInterventionError, match=r"internvla-m1.*`bridge`"):
        intervene_on(copy, Interchange(sites=("backbone.*", "memory.00")), source, load=load)
    told = CliRunner().invoke(app, ["intervene", str(copy.path), "--kind", "interchange", "--sites", "memory.*"])
    assert told.exit_code != 0
    assert isinstance(told.exception, UnsupportedInterventionError) or "bridge" in told.output
