"""Words as donors, what one step owes to them, and the memory as a place: on a real run of the untrained
network."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UnknownSiteError, UnsupportedInterventionError, UsageError
from probe_kit.intervene import (
    InstructionSwap,
    Interchange,
    InterventionResult,
    ReplayFiles,
    load_effects,
    run_intervention,
)
from probe_kit.intervene.kinds.instruction_swap import input_sensitivity
from probe_kit.intervene.places import resolve_sites, roles_of
from probe_kit.intervene.sessions import ReplaySession
from probe_kit.intervene.tokens import token_mask
from probe_kit.runs import Run
from tests.intervene.answers import with_parts

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


@pytest.fixture(scope="module")
def worded(copy: Run, source: ReplayFiles, twin: "Policy") -> InterventionResult:
    return run_intervention(copy, InstructionSwap(categories=("color",), items=2), source, load=lambda *_: twin)


# -- words ---------------------------------------------------------------------------------------------------


def test_an_item_asked_in_its_twins_words_does_what_its_twin_does(
    session: ReplaySession, worded: InterventionResult
) -> None:
    """By hand: the same picture, state and noise, and the words of the item that asks for the other one."""
    outcomes = worded.outcomes
    for replay_input in session.pairs(outcomes.items[0]):
        row = list(outcomes.episodes).index(replay_input.episode)
        words = session.counterparts[replay_input.item].instruction
        exchanged = session.with_other_instruction(replay_input)
        assert exchanged.instruction == words != replay_input.clean.instruction
        chunk = session.act(replace(replay_input.clean, instruction=words), replay_input.seed)
        assert outcomes.of("instruction_swap")[row] == pytest.approx(
            session.lateral_displacement(chunk, replay_input.clean), abs=0
        )


def test_four_inferences_per_episode_tell_words_from_pictures_and_noise(
    copy: Run, worded: InterventionResult
) -> None:
    assert worded.outcomes.conditions == ("clean", "instruction_swap", "image_swap", "noise")
    assert worded.certificate["items"] == {"asked": 2, "played": 2}
    assert worded.certificate["replay"]["equal"] == 4
    (line,) = worded.table.to_dict("records")
    assert line["category"] == "color"
    assert line["instruction_changed"] == line["images_changed"] == 1.0
    assert min(line["instruction"], line["images"], line["noise"]) > 0
    assert load_effects(copy, kind="instruction-swap").to_csv() == worded.to_csv()
    assert "Is the instruction read?" in str(worded.to_rich().title)


def test_a_policy_that_is_deaf_is_told_from_one_that_is_blind(worded: InterventionResult) -> None:
    outcomes = worded.outcomes
    moved = np.zeros_like(outcomes.displacement)
    moved[2] = 0.07
    deaf = replace(outcomes, displacement=moved, max_action_change=np.abs(moved))
    row = input_sensitivity(deaf)
    assert (row.instruction, row.images, row.noise) == (0.0, 0.07, 0.0)
    assert (row.instruction_changed, row.images_changed) == (0.0, 1.0)


def test_items_without_a_twin_are_passed_over_and_counted(
    session: ReplaySession, worded: InterventionResult
) -> None:
    alone, paired = str(worded.outcomes.items[0]), str(worded.outcomes.items[-1])
    session.counterparts = {name: twin for name, twin in session.counterparts.items() if name != alone}
    assert InstructionSwap().eligible_items(session, [alone, paired]) == [paired]
    with pytest.raises(UsageError, match="has a counterpart in its suite"):
        InstructionSwap().eligible_items(session, [alone])
    passed = with_parts(worded, certificate={**worded.certificate, "items": {"asked": 2, "played": 1}})
    assert passed.notes[0] == "1 of 2 items have no counterpart and were skipped."


def test_a_family_whose_inference_is_one_action_is_marked(worded: InterventionResult) -> None:
    shadow = {**worded.certificate, "supported": {"readout": "per-step"}}
    for certificate, is_said in ((worded.certificate, False), (shadow, True)):
        notes = with_parts(worded, certificate=certificate).notes
        assert any("one action in greedy bins" in note for note in notes) is is_said


# -- memory --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_what_every_block_hands_over_is_a_place_and_all_of_it_is_the_exchange(
    copy: Run, source: ReplayFiles, twin: "Policy"
) -> None:
    intervention = Interchange(categories=("color",), items=1, sites=("kv.*",), roles=("all", "image", "language"))
    effects = run_intervention(copy, intervention, source, load=lambda *_: twin)
    assert twin.prompt_kv is not None
    blocks = twin.prompt_kv.layers - 1
    assert {row.sites for row in effects.effects} == {f"kv.{block:02d}" for block in range(blocks)}
    for name, counts in effects.certificate["edits"].items():
        assert counts["fires"] == 2 * 2, name  # keys and values, in two episodes
    words = effects.certificate["edits"]["kv.00|language"]
    assert (words["no_op_fires"], words["max_action_change"]) == (
        4.0,
        0.0,
    )  # block 0's own words have seen no picture yet
    assert effects.certificate["edits"]["kv.00|image"]["max_action_change"] > 0


def test_a_memory_has_the_backbones_roles_and_no_layer_behind_its_last_block(
    session: ReplaySession, copy: Run
) -> None:
    (replay_input, _) = session.pairs(str(copy.episodes["item_id"][0]))
    mask = token_mask(session.policy, replay_input.clean, "kv", "image")
    np.testing.assert_array_equal(mask, token_mask(session.policy, replay_input.clean, "backbone", "image"))
    assert roles_of(session.policy, "kv", ("all", "image", "state")) == ["all", "image"]
    (site_group,) = resolve_sites("kv.01", session.policy)
    assert [str(site) for site in site_group.sites] == ["kv.01.keys", "kv.01.values"]
    assert session.policy.prompt_kv is not None
    for wrong in (f"kv.{session.policy.prompt_kv.layers - 1:02d}", "kv.00@1"):
        with pytest.raises(UnknownSiteError):
            resolve_sites(wrong, session.policy)


def test_a_family_without_a_memory_is_refused_before_anything_is_loaded(
    copy: Run, source: ReplayFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(copy), "model", "internvla-m1")

    def load(*_: object) -> "Policy":
        raise AssertionError("it is refused before")

    with pytest.raises(UnsupportedInterventionError, match=r"internvla-m1.*`bridge`"):
        run_intervention(copy, Interchange(sites=("backbone.*", "kv.00")), source, load=load)
    answer = CliRunner().invoke(app, ["intervene", str(copy.path), "--kind", "interchange", "--sites", "kv.*"])
    assert answer.exit_code != 0
    assert isinstance(answer.exception, UnsupportedInterventionError) or "bridge" in answer.output
