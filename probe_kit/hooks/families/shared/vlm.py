"""Base adapter of vision-language models with text answers: packing, prefill, decoding, taps, roles, outputs.

One stack of layers has two streams, distinguished by position. `backbone` is the prompt without its last position.
`answer` is the last position, whose logits choose the first token of the answer. Padding stands in front of every
row.

B rows, T positions, L blocks, D width, V vocabulary. The questions of a golden reference are whole prompts in
`dims.json` beside it. The adapter gets the part of each that its prompt template leaves open.
"""

import re
from abc import abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit._system.bounded_files import load_json
from probe_kit.errors import InstructionError, UsageError
from probe_kit.hooks.capturing.capture_context import ActivationCache, capture
from probe_kit.hooks.contract.model import AnswerModel, Prompt, Reading, Tap, Unembedding
from probe_kit.hooks.contract.observation import Observation, checked_picture
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import IMAGE_ROLE, PADDING, Site, Stream
from probe_kit.hooks.families.shared.loading import Loaded, Recipe, load_vlm
from probe_kit.hooks.families.shared.taps import ALL_BUT_LAST, ALL_TOKENS, LAST, Stack, decoder_tap
from probe_kit.hooks.families.shared.text import FramedText, QuestionFrame, TokenPrompt
from probe_kit.hooks.outputs import Arrays, Outputs, Produce, numpy_of, watch
from probe_kit.models.decoding import Decoded, LeftPacked, positions


@dataclass(frozen=True)
class Prefill:
    """The result of one pass over prompts.

    Attributes:
        network: The network, called like transformers' own classes.
        mask: (B, T).
        last: (…, B, 1), positions of the last tokens.
        logits: (B, V), choosing the first tokens of the answers.
        cache: Keys and values of all prompts.
    """

    network: Any
    mask: Tensor
    last: Tensor
    logits: Tensor
    cache: Any

    @classmethod
    def of(
        cls, network: Any, packed: LeftPacked, counted: Tensor, picture_inputs: Mapping[str, Tensor]
    ) -> "Prefill":
        """Read prompts once.

        Args:
            network: The network, called like transformers' own classes.
            packed: The prompts as one batch.
            counted: (…, B, T) positions.
            picture_inputs: Further keywords, such as pictures, or an `attention_mask` in place of the padding's.
        """
        output = network(
            input_ids=packed.ids,
            position_ids=counted,
            use_cache=True,
            logits_to_keep=1,
            **{"attention_mask": packed.mask, **picture_inputs},
        )
        last = counted.amax(dim=-1, keepdim=True)
        return cls(network, packed.mask, last, output.logits[:, -1], output.past_key_values)

    @classmethod
    def of_decoded(cls, network: Any, decoded: Decoded) -> "Prefill":
        """Return the prefill of what came before the first of decoded tokens; `network` continues it."""
        decoded.cache.crop(decoded.mask.shape[1])
        last = positions(decoded.mask)[:, -1:]
        return cls(network, decoded.mask.long(), last, decoded.logits[:, 0], decoded.cache)

    def speak(self, tokens: int, ends: Collection[int]) -> Tensor:
        """Return greedy ids (B, at most `tokens`), up to where every row has put out one of `ends`.

        The cache is left as it was, so that the same can be said again.
        """
        length = self.mask.shape[1]
        mask, position, logits = self.mask, self.last, self.logits
        tokens_out: list[Tensor] = []
        try:
            while len(tokens_out) < tokens:
                tokens_out.append(logits.argmax(dim=-1))
                if len(tokens_out) == tokens or _all_over(tokens_out, ends):
                    break
                position = position + 1
                mask = torch.cat([mask, torch.ones_like(mask[:, :1])], dim=1)
                logits = self.network(
                    input_ids=tokens_out[-1][:, None],
                    attention_mask=mask,
                    position_ids=position,
                    past_key_values=self.cache,
                    use_cache=True,
                    logits_to_keep=1,
                ).logits[:, -1]
        finally:  # the network has appended the answer to the cache, also where an error ended it
            self.cache.crop(length)
        return torch.stack(tokens_out, dim=1) if tokens_out else torch.zeros(len(mask), 0, dtype=torch.long)


def _all_over(tokens_out: list[Tensor], ends: Collection[int]) -> bool:
    spoken = torch.stack(tokens_out, dim=1).cpu().numpy()
    return bool(np.isin(spoken, list(ends)).any(axis=1).all())


class SpeakingModel(AnswerModel):
    """A model whose answers continue from a `Prefill`."""

    @property
    @abstractmethod
    def speaker(self) -> Any:
        """The network that continues a prompt."""

    @property
    @abstractmethod
    def ends(self) -> frozenset[int]:
        """The ids that end an answer."""

    @abstractmethod
    def words(self, ids: Sequence[int]) -> str:
        """The text of an answer's ids, up to its end."""

    @abstractmethod
    def option_ids(self, question: Prompt) -> list[int]:
        """The first id of every option.

        Raises:
            UsageError: For an option that changes the prompt's own ids.
        """

    @abstractmethod
    def prefill(self, questions: Sequence[Prompt]) -> Prefill:
        """Read all questions in one pass."""

    def read(self, questions: Sequence[Prompt]) -> Reading:
        """Read all questions in one prefill; see the contract."""
        self.shows_pictures(questions)
        options = [self.option_ids(question) for question in questions]
        prefill = self.prefill(questions)
        return Reading.of(prefill.logits.float().cpu().numpy(), options, prefill)

    def speak(self, reading: Reading, tokens: int) -> list[str]:
        """Return greedy text from the keys and values of the prompt on; see the contract.

        Raises:
            UsageError: For a reading of another model.
        """
        if not isinstance(reading.state, Prefill) or reading.state.network is not self.speaker:
            raise UsageError("this reading does not come from this model; pass what its read() returned")
        with torch.inference_mode():
            ids = reading.state.speak(tokens, self.ends)
        return [self.words(row) for row in ids.tolist()]


# -- the adapter ----------------------------------------------------------------------------------------------

ANSWER = "answer"
Pictures = list[NDArray[np.uint8]]


class VisionLanguageModel(SpeakingModel):
    """A loaded vision-language model.

    Subclasses say what frames a question and how a picture becomes positions.

    Attributes:
        recipe: The way from files to its network.
        stream_tolerance: Absolute tolerance of activations in golden references.
    """

    family: ClassVar[str]
    recipe: ClassVar[Recipe]
    stream_tolerance: ClassVar[float] = 3e-5
    frame: ClassVar[QuestionFrame]
    picture_token: ClassVar[str | None] = None
    """The token at the positions of a picture, if it is one of the tokenizer."""
    marks: ClassVar[int] = 0
    """The number of positions at either end of a picture's that only say where it begins and ends."""
    sums: ClassVar[bool] = True
    """Whether a block's attention and MLP are all that is added to the stream."""

    def __init__(self, loaded: Loaded[Any], tokenizer: str | None = None, **settings: str) -> None:
        """Make the streams and the card of a model.

        Args:
            loaded: The network, with what loading proved.
            tokenizer: Folder of another tokenizer; None for the checkpoint's.
            **settings: Everything else that the numbers depend on, for the card.
        """
        self.loaded, self.network = loaded, loaded.network
        self._text_folder = loaded.folder if tokenizer is None else Path(tokenizer).expanduser()
        layers, width = len(self.language.layers) + 1, int(self.text_config.hidden_size)
        heads = int(self.text_config.num_attention_heads)
        self.streams = {
            "backbone": Stream("backbone", layers, width, sums=self.sums, heads=heads),
            ANSWER: Stream(ANSWER, layers, width, 1, part="action", sums=self.sums, heads=heads),
        }
        self.further_streams = {"vision": self.vision.stream("vision")}
        self.role_names = {"backbone": (IMAGE_ROLE, "language", "special", PADDING), ANSWER: (ANSWER,)}
        options = {"frame": str(self.frame), "tokenizer": tokenizer or "the checkpoint's", **settings}
        self.card = loaded.card(self.family, options, tokenizer=tokenizer)

    @classmethod
    def load(
        cls,
        checkpoint: str | None = None,
        device: str = "cpu",
        dtype: str | None = None,
        random_weights: bool = False,
        *,
        tokenizer: str | None = None,
        weights_seed: int = 0,
        **settings: str,
    ) -> Self:
        """Load a model of any size from a folder or hub id; see `load_vlm`.

        Args:
            checkpoint: Folder or hub id.
            device: Device in torch's spelling, such as `cuda:0`.
            dtype: float32 or bfloat16; None takes that of the tensors in the file.
            random_weights: Whether the weights are drawn instead of read.
            tokenizer: Folder of another tokenizer; None for the checkpoint's.
            weights_seed: Seed of random weights.
            **settings: Further options of the family, for its constructor.
        """
        loaded = load_vlm(cls.recipe, checkpoint, device, dtype, random_weights, weights_seed)
        return cls(loaded, tokenizer, **settings)

    # -- what a family decides ---------------------------------------------------------------------------

    @cached_property
    @abstractmethod
    def vision(self) -> Stack:
        """The vision tower; the last site is its output."""

    @abstractmethod
    def picture_ids(self, height: int, width: int) -> list[int]:
        """The ids at the positions of a picture of that size, `marks` at either end included."""

    @abstractmethod
    def picture_inputs(self, pictures: Pictures) -> dict[str, Tensor]:
        """Return keywords of the network for a batch of (H, W, 3) uint8 pictures, on the model's device."""

    def positions(self, packed: LeftPacked, picture_inputs: dict[str, Tensor]) -> Tensor:
        """Return int64 positions (…, B, T); `picture_inputs` are those of the method, empty without pictures."""
        del picture_inputs
        return packed.positions()

    def other_inputs(self, packed: LeftPacked) -> dict[str, Tensor]:
        """Return further keywords of the network, with or without pictures."""
        del packed
        return {}

    @property
    def language(self) -> Any:
        """The decoder."""
        return self.network.model.language_model

    @property
    def text_config(self) -> Any:
        """The language model's configuration."""
        return self.network.config.text_config

    @property
    def causal(self) -> Any:
        """The network with the head that puts out tokens."""
        return self.network

    @property
    def unembedding(self) -> Unembedding:
        """The decoder's final norm and head."""
        return Unembedding.of_decoder(("backbone", ANSWER), self.causal, self.language.norm)

    def token_texts(self) -> tuple[str, ...]:
        """Return the text of every token by its id."""
        return self.text.texts

    # -- inputs ------------------------------------------------------------------------------------------

    @cached_property
    def text(self) -> FramedText:
        """The text side of the prompt.

        Raises:
            CheckpointError: For missing files, which it names.
        """
        text = FramedText.of(self._text_folder, self.frame, self.text_config, self.loaded.folder)
        if self.picture_token is not None:
            text.check_token(self.picture_token, int(self.network.config.image_token_id))
        return text

    def prompt(self, question: Prompt) -> TokenPrompt:
        """The whole prompt of a question.

        Raises:
            InstructionError: For text that does not fit in.
            ObservationError: For a picture of another dtype or shape.
        """
        ids = None
        if question.pictured:
            ids = self.picture_ids(*checked_picture(question.observation.image).shape[:2])
        prompt = self.text.prompt(question.text, question.begun, ids, self.marks)
        limit = int(self.text_config.max_position_embeddings)
        if len(prompt.ids) > limit:
            raise InstructionError(
                f"a prompt makes {len(prompt.ids)} positions; this model has {limit}. Shorten it, or show a "
                "smaller picture"
            )
        return prompt

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each whole prompt, as it is without a picture."""
        return [self.text.prompt(instruction).ids for instruction in instructions]

    # -- answering ---------------------------------------------------------------------------------------

    def prefill(self, questions: Sequence[Prompt]) -> Prefill:
        """Read all questions in one pass."""
        self.check([question.observation for question in questions])
        picture_inputs: dict[str, Tensor] = {}
        if self.shows_pictures(questions):
            picture_inputs = self.picture_inputs(
                [checked_picture(question.observation.image) for question in questions]
            )
        packed = self.packed([self.prompt(question) for question in questions])
        with torch.inference_mode():
            return Prefill.of(
                self.network,
                packed,
                self.positions(packed, picture_inputs),
                {**picture_inputs, **self.other_inputs(packed)},
            )

    def packed(self, prompts: Sequence[TokenPrompt]) -> LeftPacked:
        """Return prompts as one batch on the model's device."""
        return LeftPacked.of([prompt.ids for prompt in prompts], self.text.padding, self.loaded.device)

    def option_ids(self, question: Prompt) -> list[int]:
        """The first id of every option."""
        prompt = self.text.prompt(question.text, question.begun, [] if question.pictured else None)
        return [self.text.option(prompt, option) for option in question.options]

    @property
    def speaker(self) -> Any:
        """The network itself."""
        return self.network

    @property
    def ends(self) -> frozenset[int]:
        """The ids that end an answer."""
        return self.text.ends

    def words(self, ids: Sequence[int]) -> str:
        """The text of an answer's ids, up to its end."""
        return self.text.decode(ids)

    # -- capture -----------------------------------------------------------------------------------------

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles of the observations' instructions as questions."""
        return self.asked_roles([Prompt(observation, observation.instruction) for observation in observations])

    def asked_roles(self, questions: Sequence[Prompt]) -> dict[str, list[Roles]]:
        """Return the roles of questions: everything around picture and question is `special`.

        The beginning of an answer is `special` too.
        """
        self.shows_pictures(questions)
        rows = [_labels(self.prompt(question))[self._backbone_tokens] for question in questions]
        return {
            "backbone": Roles.padded(rows, front=True),
            ANSWER: [Roles.from_labels([ANSWER])] * len(rows),
        }

    def match_policies(self, matched: bool) -> None:
        """Count the prompt's last position to the backbone where `matched`.

        Policies that read the keys and values of a prompt have all of it in their backbone.
        """
        self.whole_prompt = matched

    @property
    def _backbone_tokens(self) -> slice:
        return ALL_TOKENS if self.whole_prompt else ALL_BUT_LAST

    def tap(self, site: Site) -> Tap:
        """Return the first norm of the block the site enters, the final norm, or a block's output."""
        if self.stream_of(site).part == "vision":
            return self.vision.tap(site)
        tokens = self._backbone_tokens if site.stream == "backbone" else LAST
        return decoder_tap(self.language.layers, self.language.norm, site, tokens=tokens)

    # -- verification ------------------------------------------------------------------------------------

    def further_outputs(self, first: Prompt, produced: Mapping[str, Produce]) -> dict[str, Produce]:
        """Return quantities of a golden reference that only this family has, or has in another form.

        Args:
            first: The first question.
            produced: The functions that make the quantities of every family.
        """
        del first, produced
        return {}


def _labels(prompt: TokenPrompt) -> list[str]:
    labels = ["language" if is_question else "special" for is_question in prompt.question]
    start, stop = prompt.picture
    labels[start:stop] = [IMAGE_ROLE] * (stop - start)
    return labels


# -- verification ---------------------------------------------------------------------------------------------

PIXELS, LOGITS = 1e-6, 2e-5
"""Absolute tolerances of pixels and of logits."""
LETTERS = ("A", "B")
DIMS_FILE = "dims.json"
# How the templates that references were recorded with mark a picture's place.
_PLACEHOLDER = re.compile(r"<\|vision_end\|>|<IMG_CONTEXT>|<image>")


def vlm_outputs(load: Callable[..., VisionLanguageModel], folder: Path, recorded: Arrays) -> Outputs:
    """Ask the recorded questions; see `VisionLanguageModel.further_outputs` for quantities of a family."""
    model = load(str(folder / "checkpoint"), dtype="float32")
    questions = questions_of(folder, recorded, model)
    produced = AnswerReference(model, questions, recorded).produced()
    produced = {**produced, **model.further_outputs(questions[0], produced)}
    return answer_outputs(produced, recorded, model.stream_tolerance)


def answer_outputs(produced: Mapping[str, Produce], recorded: Arrays, streams: float) -> Outputs:
    """Give every quantity the tolerance of its kind; streams are compared where `attention_mask` says so."""
    kinds = {name: _tolerance(name, streams) for name in recorded}
    mask = recorded["attention_mask"].astype(bool)
    return Outputs(
        produced,
        streams,
        ("pixel_values_index",),
        tolerances=kinds,
        absolute={name for name in recorded if not name.endswith("_sum")},
        valid=dict.fromkeys(("backbone_resid", "backbone_final_norm"), mask),
    )


def _tolerance(name: str, streams: float) -> float:
    if name.startswith("pixel_values"):
        return PIXELS
    return LOGITS if "logits" in name else streams


def recorded_texts(folder: Path) -> list[str]:
    """Return the whole prompts of a reference.

    Raises:
        UsageError: Where they do not lie beside it.
    """
    file = folder / DIMS_FILE
    if not file.is_file():
        raise UsageError(f"{file} is missing: it holds the questions that {folder} was recorded with")
    return [row["text"] for row in load_json(file)["rows"]]


def questions_of(folder: Path, recorded: Arrays, model: VisionLanguageModel) -> list[Prompt]:
    """Return the recorded questions with their pictures.

    Raises:
        UsageError: Where the whole prompts do not lie beside the reference.
    """
    letters = tuple(model.lead + letter for letter in LETTERS)
    pictures = [recorded[f"in_picture_{int(number)}"] for number in recorded["in_rows_picture"]]
    return [
        Prompt(Observation(picture, np.zeros(8, np.float32), ""), _question_between(text, model), letters)
        for text, picture in zip(recorded_texts(folder), pictures, strict=True)
    ]


def _question_between(text: str, model: VisionLanguageModel) -> str:
    """The question in a whole prompt: behind the picture's placeholder, before the frame's end."""
    end = model.frame.end
    body = text.removesuffix(end) if end.strip() else text
    return _PLACEHOLDER.split(body)[-1].lstrip("\n")


class AnswerReference:
    """The recorded questions, run through the adapter at the first request for a result of them."""

    def __init__(self, model: VisionLanguageModel, questions: Sequence[Prompt], recorded: Arrays) -> None:
        self.model, self.questions, self.recorded = model, questions, recorded

    @cached_property
    def picture_inputs(self) -> dict[str, torch.Tensor]:
        """The pictures of all rows as the network gets them."""
        return self.model.picture_inputs([question.observation.image for question in self.questions])

    @cached_property
    def batch(self) -> LeftPacked:
        """All rows as one batch."""
        return self.model.packed([self.model.prompt(question) for question in self.questions])

    @cached_property
    def captured(self) -> tuple[ActivationCache, Prefill]:
        """The activations and the result of one pass over all rows, with everything that is stored of it."""
        prefill, activations, _ = watch(self.model, lambda: self.model.prefill(self.questions))
        return activations, prefill

    @cached_property
    def alone(self) -> list[Prefill]:
        """The prefill of every row by itself."""
        return [self.model.prefill([question]) for question in self.questions]

    @cached_property
    def bare(self) -> Prompt:
        """The first question without its picture."""
        return replace(self.questions[0], pictured=False)

    def produced(self) -> dict[str, Produce]:
        """Return functions that make every output the adapter can make, whether recorded or not."""
        return {**self._inputs(), **self._pixels(), **self._streams(), **self._answers()}

    def _inputs(self) -> dict[str, Produce]:
        model = self.model
        return {
            "input_ids": lambda: self.batch.ids.numpy(),
            "attention_mask": lambda: self.batch.mask.numpy(),
            "position_ids": lambda: model.positions(self.batch, self.picture_inputs).numpy(),
            "image_grid_thw": lambda: self.picture_inputs["image_grid_thw"].numpy(),
            "token_type_ids": lambda: model.other_inputs(self.batch)["token_type_ids"].numpy(),
            "mm_token_type_ids": lambda: model.other_inputs(self.batch)["mm_token_type_ids"].numpy(),
            "textonly_input_ids": lambda: np.array([model.prompt(self.bare).ids]),
        }

    def _pixels(self) -> dict[str, Produce]:
        def values() -> NDArray[Any]:
            return self.picture_inputs["pixel_values"].float().numpy()

        def sums() -> NDArray[Any]:
            pixels = values().astype(np.float64)
            return np.array([pixels.sum(), np.abs(pixels).sum()])

        return {
            "pixel_values": values,
            "pixel_values_shape": lambda: np.array(values().shape),
            "pixel_values_at": lambda: values().ravel()[self.recorded["pixel_values_index"]],
            "pixel_values_sum": sums,
            "pixel_values_row0": lambda: self.model.picture_inputs([self.questions[0].observation.image])[
                "pixel_values"
            ].numpy(),
        }

    def _streams(self) -> dict[str, Produce]:
        def joined(layer: int, quantity: str) -> torch.Tensor:
            activations = self.captured[0]
            parts = [Site("backbone", layer, quantity), Site(ANSWER, layer, quantity, 0)]
            return torch.cat([activations[site] for site in parts], dim=1)

        layers = self.model.streams["backbone"].layers
        return {
            "backbone_resid": lambda: numpy_of(
                torch.stack([joined(layer, "residual") for layer in range(layers)])
            ),
            "backbone_final_norm": lambda: numpy_of(joined(layers - 1, "final_norm")),
            "vision_resid_row0": self.vision,
        }

    def vision(self) -> NDArray[Any]:
        """Return the input of every block of the tower for the first row's picture."""
        sites = self.model.further_streams["vision"].sites()[:-1]
        with capture(self.model, sites) as activations:
            self.model.prefill(self.questions[:1])
        values = numpy_of(torch.stack([activations[site] for site in sites]))
        flat = self.recorded["vision_resid_row0"].ndim < values.ndim
        return values[:, 0] if flat else values

    def _answers(self) -> dict[str, Produce]:
        model = self.model
        return {
            "logits_last": lambda: numpy_of(self.captured[1].logits),
            "single_logits_last": lambda: numpy_of(torch.cat([prefill.logits for prefill in self.alone])),
            "textonly_logits_last": lambda: numpy_of(model.prefill([self.bare]).logits),
            "option_ids": lambda: np.array(model.option_ids(self.questions[0])),
            "option_logits": lambda: model.read(self.questions).option_logits,
            "greedy_ids": self._greedy,
        }

    def _greedy(self) -> NDArray[np.int64]:
        """Return greedy ids behind every row, padded behind its end."""
        length = self.recorded["greedy_ids"].shape[1]
        with torch.inference_mode():
            answers = self.captured[1].speak(length, self.model.text.ends).numpy()
        return padded_answers(answers, length, self.model.text.ends, self.model.text.padding)


def padded_answers(
    answers: Sequence[NDArray[np.int64]] | NDArray[np.int64], length: int, ends: Collection[int], padding: int
) -> NDArray[np.int64]:
    """Return ids (B, length), each row up to and with its end, padded behind it.

    Args:
        answers: A row of ids per question.
        length: The length of the padded rows.
        ends: The ids that end an answer.
        padding: The id that pads.
    """
    padded = np.full((len(answers), length), padding)
    for row, ids in enumerate(answers):
        over = np.isin(ids, list(ends))
        stop = int(over.argmax()) + 1 if over.any() else len(ids)
        padded[row, :stop] = ids[:stop]
    return padded
