"""The task ask: a model answers one question about the first frame of an episode.

Every question names the left side first. If the prompt can be turned round, it is asked once more with the right
side first. Each answer is read in two ways: as the text that greedy decoding writes, and by the logits of the
admissible answers at its first token.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit.errors import PolicyFailedError, UsageError
from probe_kit.extract.prompts import Order, Phrase, phrases, side_by_side, sides
from probe_kit.extract.rollout.answers import (
    Choice,
    Said,
    letter_margins,
    outcome_of,
    read_answer,
    side_expected,
    side_said,
)
from probe_kit.extract.rollout.capturing import stored_streams
from probe_kit.extract.rollout.controllers import Inference, ModelController, Turn, vary_observation
from probe_kit.extract.settings import AskSettings
from probe_kit.extract.sources.inputs import PICTURE
from probe_kit.extract.sources.source import Source
from probe_kit.hooks.checkpoints.third_party import copy_observations
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs.layout import StoredStream
from probe_kit.suite.items import side_words

if TYPE_CHECKING:
    from probe_kit.extract.rollout.capturing import EpisodeBuffers
    from probe_kit.hooks import AnswerModel, Prompt, Reading


ANSWERED = "answered"
"""The outcome of a question that has no right answer."""
NO_OBJECT = Phrase("", "")
"""The phrase of a question that is the instruction itself."""


Form = tuple[str, Mapping[str, Said]]
"""A forced choice in words: the beginning of the answer, and its admissible continuations by meaning."""
Forced = tuple[dict[Said, float], float, bool]
"""The logits of one row's admissible answers by what each says, their share, and whether rounding decides."""


def _form(begun: str, lead: str) -> Form:
    """Return the form left, right or center behind `begun`, with `lead` in front of each."""
    return begun, {f"{lead}left": "left", f"{lead}right": "right", f"{lead}center": "center"}


class AnswerController(ModelController["AnswerModel", "Prompt"]):
    """A controller that asks an answer model.

    It captures the first inference of every episode unless nothing is stored. The entry `begun` of its identity is
    the beginning of the answer where sides were forced in words.

    Raises:
        UsageError: If an item has no phrase for what is asked, or an option is none behind this prompt.
    """

    outputs = "answers"

    def __init__(self, model: "AnswerModel", source: Source[Any], settings: AskSettings) -> None:
        """Prepare questions about a source; if it has a suite, the suite names objects and sides.

        A question about another source is the instruction.
        """
        suite = source.suite
        blank = source.example(min(source.instructions))
        self.model, self._settings, self.template = model, settings, settings.task.prompt
        self._choose_positions()  # before `_streams`, whose lengths depend on it
        self._is_scene = suite is not None
        self._phrases = {} if suite is None else phrases(suite, settings.task.query, settings.seed)
        self._item_has_side_word = {} if suite is None else {item.item_id: item.side_word for item in suite.items}
        self._instructions = source.instructions
        streams = [] if settings.capture.tokens == "none" else self._streams(blank)
        super().__init__(model, settings, streams)
        self._lens_stream = self._find_lens_stream() if self.template.lettered else None
        self._form = self._choose_form(blank)
        if self._form is not None:
            self.identity["begun"] = self._form[0]

    def infer(self, turns: Sequence[Turn]) -> list[Inference]:
        """Return the columns of the outcome of every turn; nothing is executed."""
        with self._acting():
            return [Inference(None, columns=columns) for columns in self._answer_turns(turns)]

    def _answer_turns(self, turns: Sequence[Turn]) -> list[dict[str, Any]]:
        self._choose_positions()
        observations = [self._question_observation(turn) for turn in turns]
        phrases_asked = [self._phrases.get(turn.row.columns["item_id"], NO_OBJECT) for turn in turns]
        buffers = {
            row: turn.buffers for row, turn in enumerate(turns) if self.streams and turn.buffers is not None
        }
        spoken: list[list[str]] = []
        forced: list[list[Forced]] = []
        for order in self.template.orders:
            questions = self._questions(observations, phrases_asked, order)
            reading = self._read(questions, buffers if order == "original" else {})
            spoken.append(self.model.speak(reading, self.template.tokens))
            forced.append(self._force_choices(questions, reading, order))
            # Of one order alone: an episode has one captured inference.
            if buffers and order == "original":
                self._record_lens(turns, reading)
        first = self._questions(observations, phrases_asked, "original")
        if self._input_check is None:
            self._try_inputs(first[0])
        sizes = self._sizes(first)
        return [
            self._outcome(
                turn, first[row].text, [by_row[row] for by_row in spoken], [by_row[row] for by_row in forced]
            )
            | sizes[row]
            for row, turn in enumerate(turns)
        ]

    def instruction_ids(self, instruction: str) -> tuple[int, ...] | None:
        """Return the ids of the words around a picture, if the prompt is the instruction; None for a question."""
        return super().instruction_ids(instruction) if self.template.is_instruction else None

    def _try_inputs(self, question: "Prompt") -> None:
        clean = replace(question.observation, instruction=question.text)
        texts = (other.text for other in self._blank_questions(question.observation))
        absent = self.model.absent_inputs | (set() if question.pictured else {PICTURE})
        variants = {
            name: (replace(question, observation=changed, text=changed.instruction) for changed in observations)
            for name, observations in vary_observation(clean, texts, self._ids_of, absent).items()
        }
        self._check_inputs(lambda prompt: self.model.read([prompt]).option_logits, question, variants)

    def _choose_positions(self) -> None:
        """Choose the positions of the backbone's stream; the model may serve other prompts too."""
        self.model.match_policies(self.template.is_instruction)

    # -- what is asked -----------------------------------------------------------------------------------

    def _question_observation(self, turn: Turn) -> Observation:
        (observation,) = copy_observations([turn.observation])
        if self._settings.task.picture != "side-by-side":
            return observation
        picture = side_by_side(turn.row.content, self._settings.scene.picture_shape)
        return replace(observation, image=picture)

    def _questions(
        self, observations: Sequence[Observation], objects: Sequence[Phrase], order: Order
    ) -> list["Prompt"]:
        """Return the questions for spoken answers; the logits of their options are those of its beginning."""
        from probe_kit.hooks import Prompt

        pictured = self._settings.task.picture != "none"
        options = tuple(self._spoken_options(order))
        return [
            Prompt(
                observation,
                self.template.render(phrase, order, observation.instruction),
                options,
                pictured=pictured,
            )
            for observation, phrase in zip(observations, objects, strict=True)
        ]

    def _spoken_options(self, order: Order) -> dict[str, Said]:
        """Return the meaning of an answer by its beginning."""
        lead = self.model.lead
        if not self.template.lettered:
            return {f"{lead}Yes": "yes", f"{lead}No": "no"}
        first, second = sides(order)
        return {f"{lead}A": first, f"{lead}B": second}

    def _read(self, questions: Sequence["Prompt"], buffers: "Mapping[int, EpisodeBuffers]") -> "Reading":
        if not buffers:
            return self.model.read(questions)
        return self._capturer.run(
            lambda: self.model.read(questions),
            lambda reading: reading.option_logits,
            self.model.asked_roles(questions),
            buffers,
        )

    def _force_choices(self, questions: Sequence["Prompt"], reading: "Reading", order: Order) -> list[Forced]:
        """Return the choice between the admissible answers; one in words takes a prefill of its own."""
        meaning: Mapping[str, Said] = self._spoken_options(order)
        if self._form is not None:
            begun, meaning = self._form
            reading = self.model.read(
                [replace(question, options=tuple(meaning), begun=begun) for question in questions]
            )
        if np.isnan(reading.option_logits).any():
            raise PolicyFailedError(
                "the model gave NaN as the logit of an answer; expected numbers for all of them"
            )
        ties = self.model.near_ties(reading)
        return [
            (
                dict(zip(meaning.values(), map(float, row), strict=True)),
                float(reading.option_mass[number]),
                bool(ties[number]),
            )
            for number, row in enumerate(reading.option_logits)
        ]

    def _find_lens_stream(self) -> StoredStream | None:
        """Return the stored stream whose last position chooses the letter; None without an unembedding."""
        if self.model.unembedding is None:
            return None
        stored = {stream.name: stream for stream in self.streams if "last" in stream.views}
        return stored.get(self.model.unembedding.streams[-1])

    def _record_lens(self, turns: Sequence[Turn], reading: "Reading") -> None:
        """Keep the margins of questions with left named first, where option 0 is the letter for left."""
        stream = self._lens_stream
        if stream is None or reading.option_ids is None:
            return
        for turn, letters, logits in zip(turns, reading.option_ids, reading.option_logits, strict=True):
            assert turn.buffers is not None, "the only inference of a question is captured"
            turn.buffers.wait()  # the residuals are read here, and may still be on their way from a GPU
            pooled = turn.buffers.pooled[stream.name][0]
            residuals = (pooled if stream.iterations is None else pooled[0])[:, stream.views.index("last")]
            turn.buffers.lens_margins = letter_margins(
                self.model, residuals, letters, float(logits[0] - logits[1])
            )

    # -- what came of it ---------------------------------------------------------------------------------

    def _outcome(
        self, turn: Turn, question: str, spoken: Sequence[str], forced: Sequence[Forced]
    ) -> dict[str, Any]:
        if not self._is_scene:
            return self._statement(question, spoken[0], forced[0])
        episode = turn.row.content
        expected = side_expected(self._settings.task.query, episode.side_correct)
        choice = Choice([logits for logits, _, _ in forced])
        columns: dict[str, Any] = {}
        for order, text in zip(self.template.orders, spoken, strict=True):
            read = read_answer(text, self.template, order)
            mark = "" if order == "original" else "_swapped"
            columns |= {
                f"outcome{mark}": outcome_of(read.meaning, expected),
                f"side_placed{mark}": side_said(read.meaning),
                f"answer{mark}": text,
                f"said{mark}": read.meaning,
                f"parse{mark}": read.rule,
                f"parse_tier{mark}": read.tier or "none",
            }
        for order, choice_forced in zip(self.template.orders, forced, strict=True):
            columns |= _forced_columns(choice_forced, "" if order == "original" else "_swapped")
        columns |= {
            f"margin{mark}": margin for mark, margin in zip(("", "_swapped"), choice.margins, strict=False)
        }
        phrase = self._phrases[episode.item.item_id]
        return columns | {
            "content": choice.content,
            "letter_bias": choice.letter_bias,
            "side_logits": side_said(choice.likeliest),
            "outcome_logits": outcome_of(choice.likeliest, expected),
            "side_debiased": side_said(choice.debiased),
            "outcome_debiased": outcome_of(choice.debiased, expected),
            "question": question,
            "side_word": self._item_has_side_word[episode.item.item_id] or bool(side_words(phrase.text)),
        }

    def _statement(self, question: str, text: str, forced: Forced) -> dict[str, Any]:
        """Return the columns of an answer without right and wrong; yes and no if the prompt asks for them."""
        columns = {"outcome": ANSWERED if text.strip() else "oob", "answer": text, "question": question}
        if not self.template.yes_or_no:
            return columns
        read = read_answer(text, self.template)
        return columns | {
            "said": read.meaning,
            "parse": read.rule,
            "parse_tier": read.tier or "none",
            **_forced_columns(forced),
        }

    def _sizes(self, questions: Sequence["Prompt"]) -> list[dict[str, int]]:
        """Return the length of each prompt; its last position can lie outside the backbone's stream."""
        # Without `whole_prompt` the last position is the stream `answer`, and missing in the backbone's roles.
        backbone = next(name for name, stream in self.model.streams.items() if stream.part == "backbone")
        rows, after = self.model.asked_roles(questions)[backbone], int(not self.model.whole_prompt)
        return [
            {"prompt_tokens": int(row.valid.sum()) + after, "picture_tokens": int(row.mask("image").sum())}
            for row in rows
        ]

    # -- beforehand --------------------------------------------------------------------------------------

    def _blank_questions(self, blank: Observation) -> list["Prompt"]:
        objects = sorted(
            set(self._phrases.values()) or {NO_OBJECT}, key=lambda phrase: (phrase.text, phrase.article)
        )
        if self.template.is_instruction:
            blanks = [replace(blank, instruction=text) for text in self._instructions]
            return self._questions(blanks, objects[:1] * len(blanks), "original")
        return self._questions([blank] * len(objects), objects, "original")

    def _streams(self, blank: Observation) -> list[StoredStream]:
        """Return the streams at the longest prompt; a prompt without a picture has no view of one."""
        roles = self.model.asked_roles(self._blank_questions(blank))
        played = {name: {span.role for row in rows for span in row.spans} for name, rows in roles.items()}
        names = {
            name: [role for role in self.model.role_names[name] if role in played[name]]
            for name in self.model.streams
        }
        return stored_streams(self.model, roles, names)

    def _choose_form(self, blank: Observation) -> Form | None:
        """Return the first form in which the sides differ in their first token; None for letters or yes.

        One question about a blank picture is asked: faults of prompt and options are raised before any episode.

        Raises:
            UsageError: For a prompt or options that `AnswerModel.read` refuses.
        """
        questions = self._blank_questions(blank)[:1]
        self.model.read(questions)
        if self.template.lettered or self._settings.task.query == "absent" or not self._is_scene:
            return None
        lead = self.model.lead
        begun = f"{lead}Yes," if self.template.yes_or_no else ""
        forms = [_form(begun, " " if begun else lead), _form(f"{begun} " if begun else lead, "")]
        for number, form in enumerate(forms):
            try:
                self.model.read([replace(questions[0], options=tuple(form[1]), begun=form[0])])
            except UsageError:  # an option merges with the prompt, or two begin alike
                if number == len(forms) - 1:
                    raise
            else:
                return form
        return None


def _forced_columns(forced: Forced, mark: str = "") -> dict[str, Any]:
    logits, mass, near_tie = forced
    columns: dict[str, Any] = {f"logit_{statement}{mark}": logit for statement, logit in logits.items()}
    return columns | {f"option_mass{mark}": mass, f"near_tie{mark}": near_tie}
