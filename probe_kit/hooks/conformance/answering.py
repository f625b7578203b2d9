"""Checks of models that answer: readings, text, and independence of rows and pictures."""

from dataclasses import replace

import numpy as np
import torch

from probe_kit.errors import ObservationError, UsageError
from probe_kit.hooks.capturing.capture_context import capture
from probe_kit.hooks.conformance.check import SkipTest, check, expect_refusal, require, require_bits, require_close
from probe_kit.hooks.conformance.subject import AnswerSubject
from probe_kit.hooks.contract.roles import Roles


@check(
    "A reading has a logit per option, and the mass of the options is a share.",
    "Return `Reading.of(logits, options, state)` with the logits behind the prompt.",
)
def a_reading_has_a_logit_per_option_and_their_mass_is_a_share(subject: AnswerSubject) -> None:
    rows, reading = len(subject.questions_of_batch), subject.read(subject.questions_of_batch)
    shape = (rows, len(subject.letters))
    require(reading.option_logits.shape == shape, f"logits of shape {reading.option_logits.shape}", f"{shape}")
    mass = reading.option_mass
    require(mass.shape == (rows,), f"option_mass of shape {mass.shape}", f"({rows},)")
    require(bool(((mass > 0) & (mass <= 1)).all()), f"option_mass {mass.tolist()}", "shares in (0, 1]")


@check(
    "Text repeats, and there is one text per question.",
    "Decode greedily, and return a list of text from `speak`.",
)
def what_is_spoken_repeats_and_is_as_long_as_asked(subject: AnswerSubject) -> None:
    model, questions = subject.answer_model, subject.questions_of_batch
    first, second = (model.speak(subject.read(questions), 4) for _ in range(2))
    require(first == second, f"{first} and then {second}", "the same text for the same questions")
    require(len(first) == len(questions), f"{len(first)} texts", f"{len(questions)}, one per question")
    require(all(isinstance(text, str) for text in first), f"{first}", "text")


@check(
    "A reading can be used more than once.",
    "Copy the cache of the reading in `speak` before tokens are appended to it.",
)
def speaking_does_not_use_a_reading_up(subject: AnswerSubject) -> None:
    model, reading = subject.answer_model, subject.read(subject.questions_of_batch)
    first, second = model.speak(reading, 4), model.speak(reading, 4)
    require(first == second, f"{first} and then {second} from one reading", "the same text")
    none = model.speak(reading, 0)
    require(none == [""] * len(reading.option_logits), f"{none} for 0 tokens", "empty texts")


@check(
    "Rows in another order are answered alike.",
    "Mask padding, so that a row does not depend on its neighbours; or declare batch=1 in the card.",
)
def rows_in_another_order_are_answered_alike(subject: AnswerSubject) -> None:
    _needs_batches(subject)
    questions = subject.questions
    forth, back = subject.ask(questions), subject.ask(questions[::-1])
    require_close(forth, back[::-1], subject.tolerance, "logits in another order")


@check(
    "A far longer question in the same batch changes nothing.",
    "Mask padding and count positions from each row's first token; or declare batch=1 in the card.",
)
def a_far_longer_neighbour_changes_nothing(subject: AnswerSubject) -> None:
    _needs_batches(subject)
    short = subject.questions[0]
    longer = replace(short, text=short.text + f" {subject.instructions[0].split()[-1]}" * 6)
    together, alone = subject.ask([short, longer]), subject.ask([short])
    require_close(together[0], alone[0], subject.tolerance, "logits beside a longer question")
    pair, single = (
        subject.answer_model.speak(subject.read(questions), 4)[0] for questions in ([short, longer], [short])
    )
    require(pair == single, f"{pair!r} beside a longer question", f"{single!r}, as alone")


@check(
    "Without a picture nothing of the picture is left.",
    "Build the prompt without picture positions where `Prompt.pictured` is False; keep no state between calls.",
)
def without_a_picture_nothing_of_it_is_left(subject: AnswerSubject) -> None:
    """Check it also right behind questions about pictures: no state may stay from call to call."""
    in_words_alone = [replace(question, pictured=False) for question in subject.questions_of_batch]
    other = [
        replace(question, observation=replace(question.observation, image=255 - question.observation.image))
        for question in in_words_alone
    ]
    before = subject.ask(in_words_alone)
    subject.read(subject.questions_of_batch)
    require_bits(subject.ask(other), before, "answers without a picture", "those of another hidden picture")
    for name, rows in subject.answer_model.asked_roles(subject.led(in_words_alone)).items():
        pictured = any(row.mask("image").any() for row in rows)
        require(not pictured, f"{name} has positions with the role image", "none without a picture")


@check(
    "Questions with and without a picture do not go into one call.",
    "Call `self.shows_pictures(questions)` first in `read`; it raises UsageError.",
)
def questions_with_and_without_a_picture_do_not_go_together(subject: AnswerSubject) -> None:
    first, second = subject.questions[:2]
    with expect_refusal("one call with and without a picture", UsageError, ObservationError):
        subject.ask([first, replace(second, pictured=False)])


@check(
    "Options that begin with the same token are refused.",
    "Return `Reading.of(logits, options, state)`, which compares them.",
)
def options_that_begin_alike_are_refused(subject: AnswerSubject) -> None:
    letter = subject.letters[0]
    with expect_refusal(f"the options {letter} and {letter}", UsageError, says="same token"):
        subject.ask([replace(subject.questions[0], options=(letter, letter))])


@check(
    "A choice that rounding decides is a near tie.",
    "Leave `near_ties` as it is inherited, or compare the two largest logits with a limit for the dtype.",
)
def a_choice_that_rounding_decides_is_a_near_tie(subject: AnswerSubject) -> None:
    reading = subject.read(subject.questions_of_batch)
    apart = np.tile(np.array([[0.0, 9.0]], np.float32), (len(reading.option_logits), 1))
    ties = subject.answer_model.near_ties
    require(not ties(replace(reading, option_logits=apart)).any(), "a near tie at a margin of 9", "none")
    near = ties(replace(reading, option_logits=apart * 1e-6))
    require(bool(near.all()), "no near tie at a margin of 0.000009", "a near tie")


@check(
    "With the positions of policies, the backbone's stream has at most one position more, the last.",
    "Slice the taps and the roles of `backbone` by the same positions in `match_policies`.",
)
def the_positions_of_policies_add_at_most_the_last_one(subject: AnswerSubject) -> None:
    model, questions = subject.answer_model, subject.led(subject.questions_of_batch[:1])
    site = model.streams["backbone"].sites()[-1]

    def capture_prompt() -> tuple[torch.Tensor, Roles]:
        with capture(model, [site]) as cache:
            model.read(questions)
        return cache[site], model.asked_roles(questions)["backbone"][0]

    activation, own_roles = capture_prompt()
    model.match_policies(True)
    try:
        (matched, roles), added = capture_prompt(), int(model.whole_prompt)
    finally:
        model.match_policies(False)
    require(len(roles) == matched.shape[1], f"{len(roles)} roles", f"{matched.shape[1]}, one per position")
    require(
        matched.shape[1] == activation.shape[1] + added,
        f"{matched.shape[1]} positions",
        f"{activation.shape[1] + added}",
    )
    require(
        bool(torch.equal(matched[:, : activation.shape[1]], activation)),
        "other activations",
        "those without the last position",
    )
    require(roles.spans[0] == own_roles.spans[0], f"roles {roles.spans}", f"those of {own_roles.spans}")


def _needs_batches(subject: AnswerSubject) -> None:
    if subject.model.card.batch == 1:
        raise SkipTest(f"{subject.model.card.family} reads one question at a time")
