"""The adapter for Magma: chat template, actions as tokens, answers in text.

Sequence: beginning, system and user turn with the picture's tokens in place of one placeholder, the header of the
assistant's turn. Seven tokens follow, one per dimension, then the end of the turn; iteration k of the stream
`action` is the position that chooses the k-th. Asked a question, the same seven steps begin the answer.

References of `verify`: B batch, S positions, L blocks, N output tokens. They come without a tokenizer;
`action_config.json` beside the checkpoint holds what the original processor and evaluation client know.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit._system.bounded_files import load_json
from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.capturing.capture_context import ActivationCache
from probe_kit.hooks.checkpoints.checkpoint import SMALL_FILES
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.contract.card import ARM
from probe_kit.hooks.contract.model import Policy, Prompt, Tap
from probe_kit.hooks.contract.observation import Observation, checked_picture
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import IMAGE_ROLE, Site, Stream
from probe_kit.hooks.families.magma.checkpoint import (
    ChatText,
    load_checkpoint,
    magma_key,
    magma_statistics,
)
from probe_kit.hooks.families.magma.network import (
    ACTION_QUESTION,
    Grid,
    MagmaConfig,
    MagmaNetwork,
    MagmaPicture,
    PictureSettings,
    PictureSpan,
    choose_grid,
    prepare_picture,
    shrink_picture,
)
from probe_kit.hooks.families.shared.action_statistics import GRIPPER_OPEN, ActionStatistics, open_or_closed
from probe_kit.hooks.families.shared.action_tokens import ActionTokens
from probe_kit.hooks.families.shared.kinds import MAPS
from probe_kit.hooks.families.shared.loading import Loaded
from probe_kit.hooks.families.shared.taps import kept_prompt
from probe_kit.hooks.families.shared.text import TokenPrompt, token_ids_of
from probe_kit.hooks.families.shared.token_decoder import CHECKPOINT, TOP, TokenDecoder, chooser, top_of
from probe_kit.hooks.families.shared.vlm import Prefill, SpeakingModel
from probe_kit.hooks.outputs import (
    Arrays,
    Outputs,
    Produce,
    forward_outputs,
    generation_outputs,
    numpy_of,
    pass_outputs,
    watch,
)
from probe_kit.models.decoding import Choose, Decoded, greedy

DEFAULT_CHECKPOINT = "microsoft/Magma-8B"
SEPARATOR = "separator"
"""The role of the vectors that end every row of a picture's map."""
STEPS, BINS = 7, 256
PROMPTS = ("magma", "act2answer")
_SHRINK = 256


class Magma(TokenDecoder, Policy, SpeakingModel):
    """A loaded Magma, which acts, and answers questions in text."""

    interventions = MAPS
    picture_roles = (IMAGE_ROLE, SEPARATOR)
    network: MagmaNetwork

    def __init__(
        self,
        loaded: Loaded[MagmaNetwork],
        statistics: ActionStatistics | str,
        *,
        layer_scale: str,
        shrink: int = _SHRINK,
        prompt: str = "magma",
        temperature: float = 0.0,
        tokenizer: str | None = None,
        steps: int = STEPS,
    ) -> None:
        """Make the adapter and its card.

        Args:
            loaded: The network, with what loading proved.
            statistics: The statistics of the data set whose units the actions get, or why there are none: it
                answers without.
            layer_scale: The name that the file has for layer scales, `gamma` or `weight`.
            shrink: Side to which pictures are shrunk first; 0 for whole pictures.
            prompt: Order of the turns: `magma`, or `act2answer` for the user's first.
            temperature: 0 for the likeliest token; above, tokens are drawn.
            tokenizer: Folder of another tokenizer; None for the checkpoint's.
            steps: Tokens per inference.
        """
        super().__init__(loaded, steps)
        self._units, self.shrink, self.order, self.temperature = statistics, shrink, prompt, temperature
        self.top = top_of(CHECKPOINT, (loaded.folder,)) if temperature else TOP
        self._text_folder = loaded.folder if tokenizer is None else Path(tokenizer).expanduser()
        self.further_streams = {
            name: Stream(name, len(stage.blocks) + 1, _width(stage), part="vision", quantities=("residual",))
            for name, stage in self._stages.items()
        }
        self.prompt_kv = kept_prompt(self.config.text)
        if isinstance(statistics, str):
            key, numbers, note, whose = "none", "none", f"cannot act: {statistics}", ""
        else:
            key, numbers, whose = statistics.key, statistics.sha256, f", units of {statistics.key}"
            note = f"actions in the units and at the rate of {key}"
        side = f"shrunk to {shrink} x {shrink} first" if shrink else "whole, at any resolution"
        among = "all" if self.top is None else f"the {self.top} likeliest"
        how = f"drawn at temperature {temperature:g} among {among}" if temperature else "the likeliest"
        options = {
            "unnorm_key": key,
            "action_statistics": numbers,
            "prompt": prompt,
            "question": ACTION_QUESTION,
            "shrink": str(shrink),
            "temperature": repr(temperature),
            **({} if self.top == TOP else {"top_k": str(self.top)}),
            "tokenizer": tokenizer or "the checkpoint's",
            "layer_scale": layer_scale,
        }
        self.card = loaded.card(
            "magma",
            options,
            tokenizer=tokenizer,
            notes=(note, f"pictures: {side}; tokens: {how}"),
            embodiment=f"{ARM}{whose}",
            chunk=1,
            execute=1,
        )

    # -- inputs ------------------------------------------------------------------------------------------

    @cached_property
    def pictures(self) -> PictureSettings:
        """The settings of cutting pictures into crops."""
        return PictureSettings.of(self.config.vision, self.loaded.folder)

    def token_texts(self) -> tuple[str, ...]:
        """Return the text of every token by its id."""
        return self.text.texts

    @cached_property
    def text(self) -> ChatText:
        """The chat text.

        Raises:
            CheckpointError: For files that are missing, which it names.
        """
        return ChatText.of(self._text_folder, self.config, self.order == "act2answer")

    @cached_property
    def action_tokens(self) -> ActionTokens:
        """The ids that name values, which are the last ones before the added tokens."""
        return ActionTokens(self.text.vocabulary, BINS)

    def prompt(self, instruction: str) -> TokenPrompt:
        """The question with which the model acts on an instruction."""
        return self.text.prompt(ACTION_QUESTION.format(instruction=instruction))

    def picture(self, image: NDArray[np.uint8]) -> MagmaPicture:
        """Return the crops of a (H, W, 3) uint8 picture.

        Raises:
            ObservationError: For a picture of another dtype or shape.
        """
        checked = checked_picture(image)
        return prepare_picture(shrink_picture(checked, self.shrink) if self.shrink else checked, self.pictures)

    def span(self, ids: Sequence[int], image: NDArray[np.uint8]) -> PictureSpan:
        """The positions of the picture's tokens among those of a prompt, without preparing it."""
        height, width = (self.shrink, self.shrink) if self.shrink else checked_picture(image).shape[:2]
        return self.network.span(ids, choose_grid(width, height, self.pictures), self.pictures.base)

    # -- running -----------------------------------------------------------------------------------------

    def generate(
        self, prompts: Sequence[Sequence[int]], pictures: Sequence[MagmaPicture] | None, choose: Choose = greedy
    ) -> Decoded:
        """Return seven tokens behind every prompt; one inference, as `capture` counts it.

        Args:
            prompts: The ids of every prompt, the picture as one placeholder.
            pictures: One per prompt; None for prompts in words alone.
            choose: Gives the ids of logits (B, V); greedy by default.

        Raises:
            InstructionError: For a prompt that is too long.
        """
        for row, ids in enumerate(prompts):
            placeholder = 0 if pictures is None else 1
            span = self.network.span(ids, pictures[row].grid, self.pictures.base).length if pictures else 0
            self.check_length(len(ids) - placeholder + span)
        with torch.inference_mode():
            return self.network.decode(prompts, pictures, self.steps, choose)

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return one action per observation; a row that put out no action holds still, see `flagged`."""
        if (reason := self.embodiment_mismatch()) is not None:
            raise CheckpointError(reason)
        ids = self._tokens(observations, seeds)
        assert self.flagged is not None
        actions = open_or_closed(self.statistics.restore(self.action_tokens.values(ids)))
        for row in np.flatnonzero(self.flagged):
            actions[row] = [0] * (STEPS - 1) + [observations[row].state[-1] > GRIPPER_OPEN]
        return actions[:, None]

    @property
    def statistics(self) -> ActionStatistics:
        """The statistics that give actions their units.

        Raises:
            UsageError: Where none were chosen.
        """
        if isinstance(self._units, str):
            raise UsageError(self._units)
        return self._units

    def embodiment_mismatch(self) -> str | None:
        """Return a reason where no units are chosen, or for other actions than an end-effector delta."""
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
        """Return (B, 1, tokens): the middle of the bin that each token names, without units."""
        return np.asarray(self.action_tokens.values(self._tokens(observations, seeds))[:, None], np.float32)

    def _tokens(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.int64]:
        """Return ids (B, tokens); one inference. Rows that put out something else than one action are flagged."""
        self.check(observations, seeds)
        choose = chooser(self.temperature, seeds, self.top)
        prompts = [self.prompt(observation.instruction).ids for observation in observations]
        decoded = self.generate(prompts, [self.picture(observation.image) for observation in observations], choose)
        ids: NDArray[np.int64] = decoded.ids.cpu().numpy()
        self.flagged = ~self._is_action(ids, decoded, choose)
        return ids

    def _is_action(self, ids: NDArray[np.int64], decoded: Decoded, choose: Choose) -> NDArray[np.bool_]:
        """Return (B,) which rows put out seven tokens that name bins, and then the end of the turn."""
        names_bins = np.asarray(self.action_tokens.is_action(ids).all(axis=1))
        if not names_bins.any():
            return names_bins
        ends = np.isin(choose(self._behind(decoded)).cpu().numpy(), list(self.text.ends))
        return np.asarray(names_bins & ends)

    def _behind(self, decoded: Decoded) -> Tensor:
        """Return the logits (B, V) behind the seven tokens, from modules without hooks."""
        with torch.inference_mode():
            return self.network.logits_behind(decoded, self.speaker)

    @cached_property
    def speaker(self) -> Any:
        """The language model's weights in modules of their own, so that what runs there fires no tap."""
        return self.network.unhooked()

    # -- answering ---------------------------------------------------------------------------------------

    def option_ids(self, question: Prompt) -> list[int]:
        """The first id of every option."""
        text, begun = question.text, question.begun
        return [self.text.option(text, begun, option, question.pictured) for option in question.options]

    def prefill(self, questions: Sequence[Prompt]) -> Prefill:
        """Run one inference: the prefill, whose logits compare the options, and six steps into the answer."""
        self.check([question.observation for question in questions])
        prompts = [self._question(question).ids for question in questions]
        pictured = self.shows_pictures(questions)
        pictures = [self.picture(question.observation.image) for question in questions] if pictured else None
        return Prefill.of_decoded(self.speaker, self.generate(prompts, pictures))

    def _question(self, question: Prompt) -> TokenPrompt:
        return self.text.prompt(question.text, question.begun, question.pictured)

    @property
    def ends(self) -> frozenset[int]:
        """The ids that end the turn."""
        return self.text.ends

    def words(self, ids: Sequence[int]) -> str:
        """The text of an answer's ids, up to the end of the turn."""
        return self.text.decode(ids)

    # -- capture -----------------------------------------------------------------------------------------

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles of frames, which are `special`, and of the question, which is `language`.

        The ends of a picture's rows have a role of their own.
        """
        return self.roles_of(
            [self._labels(self.prompt(observation.instruction), observation.image) for observation in observations]
        )

    def asked_roles(self, questions: Sequence[Prompt]) -> dict[str, list[Roles]]:
        """The roles of questions other than what to do; the beginning of an answer is `special`."""
        pictured = self.shows_pictures(questions)
        return self.roles_of(
            [
                self._labels(self._question(question), question.observation.image if pictured else None)
                for question in questions
            ]
        )

    def _labels(self, prompt: TokenPrompt, image: NDArray[np.uint8] | None) -> list[str]:
        """The labels of every position but the last, which belongs to the stream `action`."""
        labels = ["language" if is_question else "special" for is_question in prompt.question]
        if image is None:
            return labels[:-1]
        span = self.span(prompt.ids, image)
        row = [IMAGE_ROLE] * span.columns + [SEPARATOR]
        labels[span.start : span.start + 1] = row * span.rows
        return labels[:-1]

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each whole prompt, the picture as one placeholder."""
        return [self.prompt(instruction).ids for instruction in instructions]

    def vision_tap(self, site: Site) -> Tap:
        """Return the tap of `vision_<k>`: maps of stage k as tokens, one row per crop; the last is its output."""
        blocks = self._stages[site.stream].blocks
        if site.layer == len(blocks):
            return Tap(blocks[-1], 1, "output", view=_as_tokens)
        return Tap(blocks[site.layer], 1, view=_as_tokens)

    @property
    def _stages(self) -> dict[str, Any]:
        return {f"vision_{number}": stage for number, stage in enumerate(self.network.vision_tower.stages)}


def _width(stage: Any) -> int:
    return int(stage.blocks[0].conv_dw.in_channels)


def _as_tokens(maps: Tensor) -> Tensor:
    """Return maps (N, C, h, w) as tokens (N, h · w, C), in the same memory."""
    return maps.flatten(2).transpose(1, 2)


def check_magma_words(
    checkpoint: str, instructions: Sequence[str], *, tokenizer: str | None = None, prompt: str = "magma", **_: Any
) -> None:
    """Raise InstructionError for an instruction that cannot be read; see `Family.words`."""
    folder = checkpoint_folder(checkpoint, SMALL_FILES)
    text_folder = folder if tokenizer is None else Path(tokenizer).expanduser()
    text = ChatText.of(text_folder, MagmaConfig.from_folder(folder), prompt == "act2answer")
    for instruction in instructions:
        text.prompt(ACTION_QUESTION.format(instruction=instruction))


def magma_units(checkpoint: str, *, unnorm_key: str | None = None, statistics: str | None = None, **_: Any) -> str:
    """Return the data set whose units the actions get, and what says so; see `Family.units`.

    Without a choice it is the reason why there are none: a Magma may be asked, and not act.
    """
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

    Raises what `load_checkpoint` raises, too.

    Args:
        checkpoint: Folder or hub id; None loads the released one.
        device: Device in torch's spelling, such as `cuda:0`.
        dtype: float32 or bfloat16; None takes what the checkpoint says.
        random_weights: Whether the weights are drawn instead of read.
        unnorm_key: Data set whose units the actions get; None for the only one.
        statistics: File with action statistics; None for the checkpoint's, or else the package's.
        shrink: Side to which pictures are shrunk first; 0 for whole pictures.
        prompt: Order of the turns: `magma`, or `act2answer` for the user's first.
        temperature: 0 for the likeliest token; above, tokens are drawn.
        tokenizer: Folder of another tokenizer; None for the checkpoint's.
        layer_scale: `gamma` refuses files that name layer scales otherwise; None accepts either name.
        weights_seed: Seed of random weights.
        steps: Tokens per inference, for comparisons with other than seven; only seven are an action.

    Raises:
        UsageError: For an option that cannot be used.
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
    name = checkpoint or DEFAULT_CHECKPOINT
    loaded, stored_name = load_checkpoint(
        name, device, dtype, random_weights, weights_seed=weights_seed, layer_scale=layer_scale
    )
    return Magma(
        loaded,
        _units(*magma_statistics(loaded.folder, statistics), unnorm_key),
        layer_scale=stored_name,
        shrink=shrink,
        prompt=prompt,
        temperature=temperature,
        tokenizer=tokenizer,
        steps=steps,
    )


# -- verification ---------------------------------------------------------------------------------------------

TOLERANCE = 2e-5
_CLIENT = "action_config.json"
_INPUTS = (
    "image1_uint8", "image2_uint8", "input_ids", "attention_mask", "text_input_ids", "batch_input_ids",
    "batch_attention_mask", "batch_pixel_values", "batch_image_sizes", "action_token_ids", "crop_sizes_wh",
)  # fmt: skip
# The released processor's numbers, with which the choice of crops is recorded whatever the checkpoint's are.
_RELEASED = PictureSettings(512, 4)


def magma_outputs(load: Callable[..., Magma], folder: Path, recorded: Arrays) -> Outputs:
    """Run the recorded pictures and prompt through the adapter."""
    file = folder / "checkpoint" / _CLIENT
    client: dict[str, Any] = load_json(file) if file.is_file() else {}
    steps = int(recorded["generated_ids"].size) if "generated_ids" in recorded else 1
    statistics = str(file) if "norm_stats" in client else None
    model = load(str(folder / "checkpoint"), shrink=0, steps=steps, statistics=statistics)
    reference = _Reference(model, recorded, client)
    return Outputs(reference.produced(), TOLERANCE, _INPUTS, valid=reference.valid())


class _Reference:
    """The recorded inputs, run through the adapter at the first request for a result of them."""

    def __init__(self, model: Magma, recorded: Arrays, client: Mapping[str, Any]) -> None:
        self.model, self.recorded, self.client = model, recorded, client
        self.prompt: list[int] = recorded["input_ids"].ravel().tolist()

    @cached_property
    def first(self) -> tuple[MagmaPicture, Decoded, ActivationCache]:
        """The first picture and the recorded prompt, through the adapter."""
        return self._run(self.recorded["image1_uint8"])

    def _run(self, image: NDArray[np.uint8]) -> tuple[MagmaPicture, Decoded, ActivationCache]:
        picture = self.model.picture(image)
        decoded, activations, _ = watch(
            self.model, lambda: self.model.generate([self.prompt], [picture], self._choose)
        )
        return picture, decoded, activations

    @cached_property
    def second(self) -> tuple[MagmaPicture, dict[str, Produce]]:
        """The second picture, and what comes of it and the prompt."""
        picture, decoded, activations = self._run(self.recorded["image2_uint8"])
        return picture, generation_outputs(self.model, "action", activations, decoded)

    @property
    def _choose(self) -> Choose:
        """Chooses the likeliest token that does not end the turn: the recording asked for a fixed number."""
        end = self.client.get("special_ids", {}).get("eos", self.model.config.text.eos_token_id)
        ends = sorted(token_ids_of(end))

        def choose(logits: Tensor) -> Tensor:
            return logits.index_fill(1, torch.tensor(ends, dtype=torch.long), float("-inf")).argmax(dim=-1)

        return choose

    def valid(self) -> dict[str, NDArray[np.bool_]]:
        """Return the positions of the recorded batch that are no padding."""
        if "batch_attention_mask" not in self.recorded or "batch_logits" not in self.recorded:
            return {}
        mask = np.zeros(self.recorded["batch_logits"].shape[:2], bool)
        for row, length in enumerate(self._batch_lengths):
            mask[row, mask.shape[1] - length :] = True
        return dict.fromkeys(("batch_hidden_states", "batch_logits"), mask)

    def produced(self) -> dict[str, Produce]:
        """Return functions that make every output the adapter can make, whether recorded or not."""
        return {**self._pictures(), **self._streams(), **self._passes(), **self._actions()}

    def _pictures(self) -> dict[str, Produce]:
        def stage(number: int) -> Produce:
            return lambda: self._map(f"vision_{number}", -1)

        return {
            "pixel_values": lambda: numpy_of(self.first[0].crops[None]),
            "pixel_values_2": lambda: numpy_of(self.second[0].crops[None]),
            "image_sizes": lambda: _sizes(self.first[0]),
            "image_sizes_2": lambda: _sizes(self.second[0]),
            "crop_grids_hw": self._grids,
            "stem": lambda: self._map("vision_0", 0),
            **{f"stage{number}": stage(number) for number in range(len(self.model.further_streams))},
            "projected": self._projected,
        }

    def _grids(self) -> NDArray[np.int64]:
        grids = [
            choose_grid(width, height, _RELEASED) for width, height in self.recorded["crop_sizes_wh"].tolist()
        ]
        return np.array([(grid.rows, grid.columns) for grid in grids])

    def _map(self, stream: str, layer: int) -> NDArray[Any]:
        """Return maps (N, C, h, w) of the tokens that a vision stream's tap gives.

        Maps have the shape of what was shown.
        """
        layers = self.model.further_streams[stream].layers
        tokens = self.first[2][Site(stream, layer % layers)]
        height, width = self.model.network.trunk_input(self.first[0]).shape[-2:]
        high = round(np.sqrt(tokens.shape[1] * height / width))
        return numpy_of(tokens.transpose(1, 2).reshape(len(tokens), -1, high, tokens.shape[1] // high))

    @torch.inference_mode()
    def _projected(self) -> NDArray[Any]:
        network = self.model.network
        maps = network.vision_tower(network.trunk_input(self.first[0]))
        return numpy_of(network.multi_modal_projector(maps.permute(0, 2, 3, 1)))

    def _streams(self) -> dict[str, Produce]:
        _, decoded, activations = self.first
        outputs = generation_outputs(self.model, "action", activations, decoded)
        return {
            **outputs,
            "merged_embeds": lambda: outputs["hidden_states"]()[0],
            "hidden_states_2": lambda: self.second[1]["hidden_states"](),
            "logits_2": lambda: self.second[1]["logits"](),
        }

    def _passes(self) -> dict[str, Produce]:
        picture, decoded, _ = self.first
        forced = [*self.prompt, *decoded.ids[0].tolist()]
        network = self.model.network

        return {
            "teacher_forced_ids": lambda: np.array([forced]),
            **pass_outputs(
                teacher_forced=lambda: forward_outputs(network, [forced], [picture]),
                text=lambda: forward_outputs(network, [self.recorded["text_input_ids"].ravel().tolist()], None),
                batch=self._batch,
            ),
        }

    @cached_property
    def _batch_prompts(self) -> list[list[int]]:
        ids, mask = self.recorded["batch_input_ids"], self.recorded["batch_attention_mask"].astype(bool)
        return [row[is_token].tolist() for row, is_token in zip(ids, mask, strict=True)]

    @cached_property
    def _batch_pictures(self) -> list[MagmaPicture]:
        pictures = []
        for crops, size in zip(
            self.recorded["batch_pixel_values"], self.recorded["batch_image_sizes"][:, 0].tolist(), strict=True
        ):
            grid = Grid(*size)
            pictures.append(MagmaPicture(torch.from_numpy(crops[: grid.rows * grid.columns]), grid))
        return pictures

    @property
    def _batch_lengths(self) -> list[int]:
        network, side = self.model.network, int(self.recorded["batch_pixel_values"].shape[-1])
        return [
            len(ids) - 1 + network.span(ids, picture.grid, side).length
            for ids, picture in zip(self._batch_prompts, self._batch_pictures, strict=True)
        ]

    def _batch(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Run the recorded batch, packed by the adapter, and reorder it to padding in front of every row."""
        states, logits = forward_outputs(self.model.network, self._batch_prompts, self._batch_pictures)
        for row, length in enumerate(self._batch_lengths):
            for values in (states[:, row], logits[None, row]):
                first = values[:, : length - 1].copy()
                values[:, values.shape[1] - length : -1] = first
        return states, logits

    def _actions(self) -> dict[str, Produce]:
        vocabulary = self.model.config.base_vocabulary or self.client.get("tokenizer_vocab_size")
        if vocabulary is None:
            return {}
        tokens = ActionTokens(int(vocabulary), int(self.client.get("n_action_bins", BINS)))
        ids = self.recorded.get("action_token_ids", np.zeros((0, self.model.steps), np.int64))
        return {
            "normalized_actions": lambda: tokens.values(ids),
            "actions": lambda: self.model.statistics.restore(tokens.values(ids)),
            "detok_table": lambda: tokens.values(np.arange(int(self.model.config.text.vocab_size))),
        }


def _sizes(picture: MagmaPicture) -> NDArray[np.int64]:
    return np.array([[[picture.grid.rows, picture.grid.columns]]])
