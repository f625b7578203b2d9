r"""The adapter for OpenVLA: prompt, actions as tokens, units of its training data.

Sequence: beginning, 256 patches, "In: What action should the robot take to …?\nOut:" and one empty token. Seven
greedy tokens follow, one per dimension; iteration k of the stream `action` is the position that chooses the k-th.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import CheckpointError, InstructionError
from probe_kit.hooks.checkpoints.checkpoint import SMALL_FILES
from probe_kit.hooks.contract.card import ARM
from probe_kit.hooks.contract.model import Policy
from probe_kit.hooks.contract.observation import Observation, checked_picture
from probe_kit.hooks.families.prismatic.adapter import PrismaticModel
from probe_kit.hooks.families.prismatic.checkpoint import (
    checkpoint_folders,
    load_checkpoint,
    prismatic_statistics,
)
from probe_kit.hooks.families.prismatic.network import (
    CROP_AREA,
    PrismaticConfig,
    PrismaticNetwork,
    centre_crop,
    prepare_tensor,
)
from probe_kit.hooks.families.prismatic.outputs import INPUTS, Reference
from probe_kit.hooks.families.shared.action_statistics import DIMENSIONS, ActionStatistics, open_or_closed
from probe_kit.hooks.families.shared.action_tokens import ActionTokens
from probe_kit.hooks.families.shared.kinds import TOKENS
from probe_kit.hooks.families.shared.loading import Loaded
from probe_kit.hooks.families.shared.taps import kept_prompt
from probe_kit.hooks.families.shared.text import SLOT, find_tokenizer, template_of
from probe_kit.hooks.families.shared.token_decoder import ALL, chooser, top_of, warn_of_unknown
from probe_kit.hooks.outputs import Arrays, Outputs, Produce

DEFAULT_CHECKPOINT = "openvla/openvla-7b"
PROMPTS = {
    "openvla": "In: What action should the robot take to {instruction}?\nOut:",
    "openvla-v01": "A chat between a curious user and an artificial intelligence assistant. The assistant gives "
    "helpful, detailed, and polite answers to the user's questions. USER: What action should the robot take to "
    "{instruction}? ASSISTANT:",
}
# How the Llama-2 tokenizer splits the beginning of the prompt, as recorded from the original software.
_LLAMA_VOCABULARY = 32000
_LLAMA_PROMPT = [1, 512, 29901, 1724, 3158, 881, 278, 19964, 2125, 304]
_PATCH = 14


class OpenVLA(PrismaticModel, Policy):
    """A loaded OpenVLA."""

    family: ClassVar[str] = "openvla"
    interventions = TOKENS
    output: ClassVar[str] = "action"

    def __init__(
        self,
        loaded: Loaded[PrismaticNetwork],
        statistics: ActionStatistics,
        prompt: str,
        crop: bool,
        tokenizer: str | None = None,
        temperature: float = 0.0,
        resize: str = "pil",
        top: int | None = None,
    ) -> None:
        """Make the adapter and its card.

        Args:
            loaded: The network, with what loading proved.
            statistics: The statistics of the data set whose units the actions get.
            prompt: The template, with a place for the instruction.
            crop: Whether the middle of the picture is shown.
            tokenizer: Folder of another tokenizer; None for the checkpoint's.
            temperature: 0 for the likeliest token; above, tokens are drawn.
            resize: `pil`, or `tensor` as in Act2Answer's evaluation.
            top: Draw from so many of the likeliest ids that name actions; None from all.
        """
        super().__init__(loaded, steps=len(statistics.low), tokenizer=tokenizer)
        self.prompt_kv = kept_prompt(self.config.text)
        self.statistics, self.template, self.crop = statistics, prompt, crop
        self.temperature, self.resize, self.top = temperature, resize, top if temperature else None
        self.action_tokens = ActionTokens(self.config.action_vocabulary, self.config.action_bins)
        self.card = replace(
            self.card,
            embodiment=f"{ARM}, units of {statistics.key}",
            chunk=1,
            execute=1,
            notes=(*self.card.notes, *self._notes()),
            settings={
                **self.card.settings,
                "unnorm_key": self.statistics.key,
                "action_statistics": self.statistics.sha256,
                "prompt": self.template,
                "centre_crop": str(self.crop),
                **({"temperature": repr(temperature)} if temperature else {}),
                **({} if self.top is None else {"top_k": str(self.top)}),
                **({"resize": resize} if resize != "pil" else {}),
            },
        )

    def _notes(self) -> tuple[str, ...]:
        notes = [f"actions in the units and at the rate of {self.statistics.key}", f"prompt: {self.template!r}"]
        if self.crop:
            notes.append(f"pictures: middle {CROP_AREA:.0%} of the area")
        if self.temperature:
            among = "all" if self.top is None else f"the {self.top} likeliest"
            notes.append(f"action tokens drawn at temperature {self.temperature:g} among {among}")
        return tuple(notes)

    # -- acting ------------------------------------------------------------------------------------------

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return one action per observation; seeds count only at a temperature. See the contract."""
        if (reason := self.embodiment_mismatch()) is not None:
            raise CheckpointError(reason)
        ids = self._tokens(observations, seeds)
        if self.flagged is not None and self.flagged.any():
            warn_of_unknown()
        return open_or_closed(self.statistics.restore(self.action_tokens.values(ids)))[:, None]

    def embodiment_mismatch(self) -> str | None:
        """Return a reason for other actions than an end-effector delta."""
        if self.steps == DIMENSIONS:
            return None
        return (
            f"{self.statistics.key} has actions of {self.steps} dimensions; Act2Answer needs a 7-DoF end-effector "
            "delta. Choose another -M unnorm_key"
        )

    def infer_without_acting(
        self, observations: Sequence[Observation], seeds: Sequence[int]
    ) -> NDArray[np.float32]:
        """Return (B, 1, tokens): the middle of the bin that each token names, without units."""
        return np.asarray(self.action_tokens.values(self._tokens(observations, seeds))[:, None], np.float32)

    def _tokens(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.int64]:
        """Return ids (B, tokens); one inference."""
        self.check(observations, seeds)
        rows = [self.prompt(observation.instruction) for observation in observations]
        pixels = self.pixel_values(self._look(observation.image) for observation in observations)
        tokens = self.action_tokens
        action_ids = range(tokens.vocabulary - tokens.bins, tokens.vocabulary)
        choose = chooser(self.temperature, seeds, self.top, action_ids)
        ids: NDArray[np.int64] = self.generate(pixels, rows, choose).ids.cpu().numpy()
        self.flagged = ~np.asarray(self.action_tokens.is_action(ids).all(axis=1))
        return ids

    def pixel_values(self, images: Iterable[NDArray[np.uint8]]) -> Tensor:
        """Return pictures (B, 3 per tower, S, S) float32, resized as asked.

        Raises:
            ObservationError: For a picture of another dtype or shape.
        """
        if self.resize == "pil":
            return super().pixel_values(images)
        rows = [prepare_tensor(checked_picture(image), self.pictures) for image in images]
        return torch.from_numpy(np.stack(rows)).to(self.loaded.device)

    def _look(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return centre_crop(image, self.config.towers[0].image_size) if self.crop else image

    def prompt(self, instruction: str) -> list[int]:
        """Return the ids of the whole prompt, the empty token last.

        Raises:
            CheckpointError: For another tokenizer's ids.
        """
        ids = self.tokenizer.encode(self.template.replace(SLOT, instruction.lower()))
        self._check_other_ids(ids)
        return self.with_empty_token(ids)

    def with_empty_token(self, ids: list[int]) -> list[int]:
        """Return ids with the empty token at the end: the model was trained with it between prompt and action."""
        empty = self.config.empty_token
        return ids if ids[-1] == empty else [*ids, empty]

    def _check_other_ids(self, ids: list[int]) -> None:
        """Compare the ids with Llama's recorded split of the prompt; another split would go unnoticed."""
        llama = self.config.text.model_type == "llama" and self.config.action_vocabulary == _LLAMA_VOCABULARY
        if llama and self.template == PROMPTS["openvla"] and ids[: len(_LLAMA_PROMPT)] != _LLAMA_PROMPT:
            raise CheckpointError(
                f"the tokenizer splits the prompt into {ids[: len(_LLAMA_PROMPT)]}…; OpenVLA was trained with "
                f"{_LLAMA_PROMPT}…. Take tokenizer.json from {DEFAULT_CHECKPOINT}"
            )


def load_openvla(
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    *,
    unnorm_key: str | None = None,
    prompt: str | None = None,
    centre_crop: bool = False,
    tokenizer: str | None = None,
    bits: int | None = None,
    temperature: float = 0.0,
    resize: str = "pil",
    top_k: str = ALL,
    weights_seed: int = 0,
) -> OpenVLA:
    """Load OpenVLA, one of its fine-tunes, or a LoRA adapter that names its base, from a folder or hub id.

    The options are those of the family. Raises what `load_checkpoint` raises, too.

    Raises:
        CheckpointError: For a Prismatic model without actions, and for bad statistics.
        UsageError: For an option that cannot be used, and for a data set that has to be chosen.
    """
    chooser(temperature, ())
    loaded = load_checkpoint(checkpoint or DEFAULT_CHECKPOINT, device, dtype, random_weights, bits, weights_seed)
    config = loaded.network.config
    if config.model_type != "openvla":
        raise CheckpointError(f"{checkpoint} is a Prismatic model without actions; pass --model prismatic")
    by_data_set, source = prismatic_statistics(config, loaded.folders)
    statistics = ActionStatistics.choose(by_data_set, unnorm_key, source)
    template = _template(prompt, config)
    top = top_of(top_k, loaded.folders)
    return OpenVLA(loaded, statistics, template, centre_crop, tokenizer, temperature, resize, top)


def openvla_units(checkpoint: str, *, unnorm_key: str | None = None, **_: Any) -> str:
    """Return the data set whose units the actions get, and what says so; see `Family.units`."""
    folders = checkpoint_folders(checkpoint, SMALL_FILES)
    by_data_set, source = prismatic_statistics(PrismaticConfig.from_folder(folders[-1]), folders)
    return f"{ActionStatistics.choose(by_data_set, unnorm_key, source).key}, from {source}"


def check_openvla_words(
    checkpoint: str,
    instructions: Sequence[str],
    *,
    prompt: str | None = None,
    tokenizer: str | None = None,
    **_: Any,
) -> None:
    """Raise InstructionError for an instruction that is too long; see `Family.words`."""
    folders = checkpoint_folders(checkpoint, SMALL_FILES)
    config = PrismaticConfig.from_folder(folders[-1])
    text = find_tokenizer(folders, tokenizer, config.text.bos_token_id)
    template = _template(prompt, config)
    room = int(config.text.max_position_embeddings) - (config.towers[0].image_size // _PATCH) ** 2 - DIMENSIONS
    for instruction in instructions:
        length = len(text.encode(template.replace(SLOT, instruction.lower())))
        if length > room:
            raise InstructionError(
                f"{instruction!r} makes {length} tokens; this model has room for {room}. Shorten it"
            )


def _template(prompt: str | None, config: PrismaticConfig) -> str:
    """Return the template of a prompt.

    The first release (openvla-7b-v01) was made of Vicuna, and has Vicuna's prompt.
    """
    first = config.language_id.startswith("vicuna")
    return template_of(prompt or ("openvla-v01" if first else "openvla"), PROMPTS)


# -- verification ---------------------------------------------------------------------------------------------

_ACTION = "action_"
_WITHOUT_EMPTY = "prompt_ids_without_empty"


def openvla_outputs(load: Callable[..., OpenVLA], folder: Path, recorded: Arrays) -> Outputs:
    """Compare a reference of a policy; each recorded `action_<data set>` with that data set's statistics.

    The adapter adds the empty token to ids that are recorded without it.
    """
    checkpoint = folder / "checkpoint"
    by_data_set = PrismaticConfig.from_folder(checkpoint).statistics
    keys = [key for key in by_data_set if _ACTION + key in recorded]
    policy = load(str(checkpoint), unnorm_key=next(iter(keys or by_data_set), None))
    added = _WITHOUT_EMPTY in recorded
    ids: list[int] = recorded[_WITHOUT_EMPTY if added else "input_ids"].ravel().tolist()
    reference = Reference(policy, recorded, policy.with_empty_token(ids) if added else ids)
    values = policy.action_tokens.values(reference.decoded.ids[0].numpy())
    statistics, _ = prismatic_statistics(policy.config, policy.loaded.folders)
    produced: dict[str, Produce] = {
        _ACTION + key: partial(ActionStatistics.choose(statistics, key).restore, values) for key in keys
    }
    every = np.arange(int(policy.config.text.vocab_size))
    inputs = INPUTS if added else (*INPUTS, "input_ids")
    return reference.outputs(inputs, detok_table=lambda: policy.action_tokens.values(every), **produced)
