"""The adapter for Magma: chat template, actions as tokens, answers in text.

Sequence: beginning, system and user turn with the picture's tokens in place of one placeholder, the header of the
assistant's turn. Seven tokens follow, one per dimension, then the end of the turn; iteration k of the stream
`action` is the position that chooses the k-th. Asked a question, the same seven steps begin the answer.
"""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import CheckpointError, InstructionError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import SMALL_FILES, content_hashes, side_files
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.contract.card import ModelCard
from probe_kit.hooks.contract.model import AnswerModel, Policy, Prompt, Reading, Tap
from probe_kit.hooks.contract.observation import Observation, checked_picture
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.hooks.contract.unembedding import Unembedding
from probe_kit.hooks.contract.views import PADDING
from probe_kit.hooks.families.magma.answer import Answer
from probe_kit.hooks.families.magma.checkpoint import (
    LoadedMagma,
    load_checkpoint,
    magma_key,
    magma_statistics,
)
from probe_kit.hooks.families.magma.text import ChatText, TokenPrompt
from probe_kit.hooks.families.openvla.actions import ActionTokens
from probe_kit.hooks.families.shared.action_statistics import ActionStatistics
from probe_kit.hooks.families.shared.attention_weights import Note, of_decoder
from probe_kit.hooks.families.shared.capabilities import MAPS
from probe_kit.hooks.families.shared.decoder_tap import decoder_tap
from probe_kit.hooks.families.shared.prompt_kv import ALL_BUT_LAST, kept_prompt, kv_tap
from probe_kit.hooks.families.shared.sampling import CHECKPOINT, TOP, chooser, top_of
from probe_kit.models.magma import (
    ACTION_QUESTION,
    Choose,
    Decoded,
    MagmaConfig,
    Picture,
    PictureSettings,
    PictureSpan,
    choose_grid,
    greedy,
    prepare_picture,
    shrink_picture,
)

DEFAULT_CHECKPOINT = "microsoft/Magma-8B"
CAMERA = "primary"
SEPARATOR = "separator"
"""Role of the vectors that end every row of a picture's map."""
STEPS, BINS = 7, 256
PROMPTS = ("magma", "act2answer")
_SHRINK = 256
_GRIPPER_OPEN = 0.5
_PROMPT, _LAST = slice(None, -1), slice(-1, None)


class Magma(Policy, AnswerModel):
    """A loaded Magma: acts, and answers questions in text."""

    interventions = MAPS

    def __init__(
        self,
        loaded: LoadedMagma,
        statistics: ActionStatistics | str,
        *,
        shrink: int = _SHRINK,
        prompt: str = "magma",
        temperature: float = 0.0,
        tokenizer: str | None = None,
        steps: int = STEPS,
    ) -> None:
        """statistics: of the data set whose units the actions get, or why there are none: it answers without."""
        self.loaded, self.network, self.config = loaded, loaded.network, loaded.config
        self._units, self.shrink, self.order, self.temperature = statistics, shrink, prompt, temperature
        self.steps = steps
        self.top = top_of(CHECKPOINT, (loaded.folder,)) if temperature else TOP
        self._text_folder = loaded.folder if tokenizer is None else Path(tokenizer).expanduser()
        self.decoder: Any = self.network.language_model.model
        layers, width = len(self.decoder.layers) + 1, int(self.config.text.hidden_size)
        heads = int(self.config.text.num_attention_heads)
        self.streams = {
            "backbone": Stream("backbone", layers, width, heads=heads),
            "action": Stream("action", layers, width, steps, part="action", heads=heads),
        }
        self.further_streams = {
            name: Stream(name, len(stage.blocks) + 1, _width(stage), part="vision", quantities=("residual",))
            for name, stage in self._stages.items()
        }
        self.prompt_kv = kept_prompt(self.config.text)
        self.role_names = {
            "backbone": (f"image.{CAMERA}", SEPARATOR, "language", "special", PADDING),
            "action": ("action",),
        }
        self.card = self._card({"tokenizer": tokenizer or "the checkpoint's", "layer_scale": loaded.layer_scale})

    def _card(self, options: dict[str, str]) -> ModelCard:
        loaded, units = self.loaded, self._units
        if isinstance(units, str):
            key, numbers, note, whose = "none", "none", f"cannot act: {units}", ""
        else:
            key, numbers, whose = units.key, units.sha256, f", units of {units.key}"
            note = f"actions in the units and at the rate of {key}"
        files = side_files(loaded.folder)
        if self._text_folder != loaded.folder and self._text_folder.is_dir():
            files |= side_files(self._text_folder, "tokenizer/")
        side = f"shrunk to {self.shrink} x {self.shrink} first" if self.shrink else "whole, at any resolution"
        among = "all" if self.top is None else f"the {self.top} likeliest"
        how = f"drawn at temperature {self.temperature:g} among {among}" if self.temperature else "the likeliest"
        return ModelCard(
            family="magma",
            checkpoint=loaded.checkpoint,
            weights_sha256=loaded.audit.sha256,
            random_weights=loaded.audit.random,
            parameters=loaded.audit.parameters,
            dtype=loaded.dtype,
            device=loaded.device,
            embodiment=f"7-DoF end-effector delta, one third-person camera{whose}",
            cameras=(CAMERA,),
            chunk=1,
            execute=1,
            notes=(
                *loaded.notes,
                note,
                f"pictures: {side}; tokens: {how}",
            ),
            audit=loaded.audit.to_json(),
            settings={
                **content_hashes(files),
                "unnorm_key": key,
                "action_statistics": numbers,
                "prompt": self.order,
                "question": ACTION_QUESTION,
                "shrink": str(self.shrink),
                "temperature": repr(self.temperature),
                **({} if self.top == TOP else {"top_k": str(self.top)}),
                **options,
            },
            weights_seed=loaded.weights_seed,
        )

    # -- inputs ------------------------------------------------------------------------------------------

    @cached_property
    def pictures(self) -> PictureSettings:
        """The settings of cutting pictures into crops."""
        return PictureSettings.of(self.config.vision, self.loaded.folder)

    @cached_property
    def text(self) -> ChatText:
        """The chat text. Raises CheckpointError naming the files that are missing."""
        return ChatText.of(self._text_folder, self.config, self.order == "act2answer")

    @cached_property
    def action_tokens(self) -> ActionTokens:
        """The ids that name values: the last ones before the added tokens."""
        return ActionTokens(self.text.vocabulary, BINS)

    def prompt(self, instruction: str) -> TokenPrompt:
        """The question with which the model acts on an instruction."""
        return self.text.prompt(ACTION_QUESTION.format(instruction=instruction))

    def picture(self, image: NDArray[np.uint8]) -> Picture:
        """Crops of a (H, W, 3) uint8 picture. Raises ObservationError."""
        checked = checked_picture(image)
        return prepare_picture(shrink_picture(checked, self.shrink) if self.shrink else checked, self.pictures)

    def span(self, ids: Sequence[int], image: NDArray[np.uint8]) -> PictureSpan:
        """The positions of the picture's tokens among those of a prompt, without preparing it."""
        height, width = (self.shrink, self.shrink) if self.shrink else checked_picture(image).shape[:2]
        return self.network.span(ids, choose_grid(width, height, self.pictures), self.pictures.base)

    # -- running -----------------------------------------------------------------------------------------

    def generate(
        self, prompts: Sequence[Sequence[int]], pictures: Sequence[Picture] | None, choose: Choose = greedy
    ) -> Decoded:
        """Seven tokens behind every prompt; one inference, as `capture` counts it. Raises InstructionError."""
        limit = int(self.config.text.max_position_embeddings)
        for row, ids in enumerate(prompts):
            length = len(ids) + self.steps
            if pictures is not None:
                length += self.network.span(ids, pictures[row].grid, self.pictures.base).length - 1
            if length > limit:
                raise InstructionError(f"a prompt makes {length} positions; this model has {limit}. Shorten it")
        with torch.inference_mode():
            return self.network.decode(prompts, pictures, self.steps, choose)

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """One action per observation; a row that put out no action holds still, see `flagged` and the contract."""
        if (reason := self.embodiment_mismatch()) is not None:
            raise CheckpointError(reason)
        ids = self._tokens(observations, seeds)
        assert self.flagged is not None
        actions = self.statistics.restore(self.action_tokens.values(ids))
        actions[:, -1] = actions[:, -1] > _GRIPPER_OPEN
        for row in np.flatnonzero(self.flagged):
            actions[row] = [0] * (STEPS - 1) + [observations[row].state[-1] > _GRIPPER_OPEN]
        return actions[:, None].astype(np.float32)

    @property
    def statistics(self) -> ActionStatistics:
        """The statistics that give actions their units. Raises UsageError where none were chosen."""
        if isinstance(self._units, str):
            raise UsageError(self._units)
        return self._units

    def embodiment_mismatch(self) -> str | None:
        """No chosen units, or other actions than an end-effector delta."""
        if isinstance(self._units, str):
            return self._units
        if len(self.statistics.low) == self.steps == STEPS:
            return None
        return (
            f"{self.statistics.key} has actions of {len(self.statistics.low)} dimensions and Magma puts out "
            f"{self.steps} tokens; Act2Answer needs {STEPS} of both. Choose another -M unnorm_key"
        )

    def infer_without_acting(
        self, observations: Sequence[Observation], seeds: Sequence[int]
    ) -> NDArray[np.float32]:
        """(B, 1, tokens): the middle of the bin that each token names, without units."""
        return np.asarray(self.action_tokens.values(self._tokens(observations, seeds))[:, None], np.float32)

    def _tokens(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.int64]:
        """(B, tokens) ids; one inference. Rows that put out something else than one action are flagged."""
        self.check(observations, seeds)
        choose = chooser(self.temperature, seeds, self.top)
        prompts = [self.prompt(observation.instruction).ids for observation in observations]
        decoded = self.generate(prompts, [self.picture(observation.image) for observation in observations], choose)
        ids: NDArray[np.int64] = decoded.ids.cpu().numpy()
        self.flagged = ~self._is_action(ids, decoded, choose)
        return ids

    def _is_action(self, ids: NDArray[np.int64], decoded: Decoded, choose: Choose) -> NDArray[np.bool_]:
        """(B,) which rows put out seven tokens that name bins, and then the end of the turn."""
        names_bins = np.asarray(self.action_tokens.is_action(ids).all(axis=1))
        if not names_bins.any():
            return names_bins
        ends = np.isin(choose(self._behind(decoded)).cpu().numpy(), list(self.text.ends))
        return np.asarray(names_bins & ends)

    def _behind(self, decoded: Decoded) -> Tensor:
        """(B, V) logits behind the seven tokens, from modules without hooks."""
        with torch.inference_mode():
            return decoded.decoding.feed(decoded.ids[:, -1], self._unhooked)

    @cached_property
    def _unhooked(self) -> Any:
        """The language model's weights in modules of their own, so that what runs there fires no tap."""
        return self.network.unhooked()

    def record_attention(self, note: Note) -> AbstractContextManager[None]:
        """Computed once more for the position that chooses a token."""
        return of_decoder(self.decoder.layers, note)

    # -- answering ---------------------------------------------------------------------------------------

    def read(self, questions: Sequence[Prompt]) -> Reading:
        """One inference: the prefill, whose logits compare the options, and six steps into the answer."""
        self.check([question.observation for question in questions])
        prompts = [self._question(question).ids for question in questions]
        options = [
            [
                self.text.option(question.text, question.begun, option, question.pictured)
                for option in question.options
            ]
            for question in questions
        ]
        pictured = self.shows_pictures(questions)
        pictures = [self.picture(question.observation.image) for question in questions] if pictured else None
        decoded = self.generate(prompts, pictures)
        return Reading.of(decoded.logits[:, 0].float().cpu().numpy(), options, Answer(decoded))

    def _question(self, question: Prompt) -> TokenPrompt:
        return self.text.prompt(question.text, question.begun, question.pictured)

    def speak(self, reading: Reading, tokens: int) -> list[str]:
        """Greedy text up to the end of the turn; see the contract. Raises UsageError for another's reading."""
        answer = reading.state
        if not isinstance(answer, Answer):
            raise UsageError("this reading does not come from Magma; pass what its read() returned")
        while len(answer.ids) < tokens and not answer.over(self.text.ends):
            with torch.inference_mode():
                answer.advance(self._unhooked)
        rows = torch.stack(answer.ids[:tokens], dim=1).tolist() if tokens else [[]] * len(answer.ids[0])
        return [self.text.decode(row) for row in rows]

    # -- capture -----------------------------------------------------------------------------------------

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Frames are `special`, the question is `language`; the ends of a picture's rows stand apart from it."""
        return self._roles(
            [self._labels(self.prompt(observation.instruction), observation.image) for observation in observations]
        )

    def asked_roles(self, questions: Sequence[Prompt]) -> dict[str, list[Roles]]:
        """Roles of questions other than what to do; how an answer has begun is `special`."""
        pictured = self.shows_pictures(questions)
        return self._roles(
            [
                self._labels(self._question(question), question.observation.image if pictured else None)
                for question in questions
            ]
        )

    def _roles(self, rows: Sequence[list[str]]) -> dict[str, list[Roles]]:
        longest = max(map(len, rows))
        backbone = [Roles.from_labels(labels + [PADDING] * (longest - len(labels))) for labels in rows]
        return {"backbone": backbone, "action": [Roles.from_labels(["action"])] * len(rows)}

    def _labels(self, prompt: TokenPrompt, image: NDArray[np.uint8] | None) -> list[str]:
        """The labels of every position but the last, which belongs to the stream `action`."""
        labels = ["language" if is_question else "special" for is_question in prompt.question]
        if image is None:
            return labels[:-1]
        span = self.span(prompt.ids, image)
        row = [f"image.{CAMERA}"] * span.columns + [SEPARATOR]
        labels[span.start : span.start + 1] = row * span.rows
        return labels[:-1]

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each whole prompt, the picture as one placeholder."""
        return [self.prompt(instruction).ids for instruction in instructions]

    @property
    def unembedding(self) -> Unembedding:
        """The language model's final norm and head."""
        return Unembedding.of_decoder(("backbone", "action"), self.network.language_model, self.decoder.norm)

    def tap(self, site: Site) -> Tap:
        """The first norm of the block the site enters, the final norm, or a block's output.

        `vision_<k>`: maps of stage k as tokens, one row per crop; the last one is the stage's output.
        """
        stream = self.stream_of(site)
        if stream is self.prompt_kv:
            return kv_tap(self.network.prompt_kv, site, ALL_BUT_LAST)
        if stream.part == "vision":
            blocks = self._stages[site.stream].blocks
            if site.layer == len(blocks):
                return Tap(blocks[-1], 1, "output", view=_as_tokens)
            return Tap(blocks[site.layer], 1, view=_as_tokens)
        tokens = _PROMPT if site.stream == "backbone" else _LAST
        return decoder_tap(self.decoder.layers, self.decoder.norm, site, self.steps, tokens)

    @property
    def _stages(self) -> dict[str, Any]:
        return {f"vision_{number}": stage for number, stage in enumerate(self.network.vision_tower.stages)}


def _width(stage: Any) -> int:
    return int(stage.blocks[0].conv_dw.in_channels)


def _as_tokens(maps: Tensor) -> Tensor:
    """(N, h · w, C) of (N, C, h, w), in the same memory."""
    return maps.flatten(2).transpose(1, 2)


def check_magma_words(
    checkpoint: str, instructions: Sequence[str], *, tokenizer: str | None = None, prompt: str = "magma", **_: Any
) -> None:
    """See `Family.words`."""
    folder = checkpoint_folder(checkpoint, SMALL_FILES)
    text_folder = folder if tokenizer is None else Path(tokenizer).expanduser()
    text = ChatText.of(text_folder, MagmaConfig.from_folder(folder), prompt == "act2answer")
    for instruction in instructions:
        text.prompt(ACTION_QUESTION.format(instruction=instruction))


def magma_units(checkpoint: str, *, unnorm_key: str | None = None, statistics: str | None = None, **_: Any) -> str:
    """See `Family.units`; without a choice, why there are none: a Magma may be asked, and not act."""
    by_data_set, source = magma_statistics(checkpoint_folder(checkpoint, SMALL_FILES), statistics)
    units = _units(by_data_set, source, unnorm_key)
    return f"none: {units}" if isinstance(units, str) else f"{units.key}, from {source}"


def _units(statistics: Mapping[str, Any], source: str, key: str | None) -> ActionStatistics | str:
    try:
        return ActionStatistics.choose(statistics, magma_key(statistics, source, key), source)
    except UsageError as error:
        if key is not None:
            raise
        return str(error)


def load_magma(
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    *,
    unnorm_key: str | None = None,
    statistics: str | None = None,
    shrink: int = _SHRINK,
    prompt: str = "magma",
    temperature: float = 0.0,
    tokenizer: str | None = None,
    layer_scale: str | None = None,
    weights_seed: int = 0,
    steps: int = STEPS,
) -> Magma:
    """Load Magma or one of its fine-tunes, from a folder or hub id.

    unnorm_key: data set whose units the actions get; default the only one of the checkpoint's file, without which
    it answers and does not act. statistics: file with action statistics. shrink: side to which pictures are shrunk
    first, 0 for whole pictures. prompt: `magma`, or
    `act2answer` for the order of turns of that release. temperature: 0 for the likeliest token. tokenizer: folder
    of another tokenizer. layer_scale: see `load_checkpoint`. steps: tokens per
    inference, for comparisons with other than seven; only seven are an action.
    Raises UsageError, and what `load_checkpoint` raises.
    """
    for name, value, choices in (
        ("prompt", prompt, PROMPTS),
        ("layer_scale", layer_scale, (None, "gamma", "weight")),
    ):
        if value not in choices:
            raise UsageError(f"{name} is {value!r}; expected {' or '.join(filter(None, choices))}")
    if shrink < 0:
        raise UsageError(f"shrink is {shrink}; expected a side in pixels, or 0 for whole pictures")
    chooser(temperature, ())
    loaded = load_checkpoint(
        checkpoint or DEFAULT_CHECKPOINT,
        device,
        dtype,
        random_weights,
        weights_seed=weights_seed,
        statistics=statistics,
        layer_scale=layer_scale,
    )
    return Magma(
        loaded,
        _units(loaded.statistics, loaded.statistics_source, unnorm_key),
        shrink=shrink,
        prompt=prompt,
        temperature=temperature,
        tokenizer=tokenizer,
        steps=steps,
    )
