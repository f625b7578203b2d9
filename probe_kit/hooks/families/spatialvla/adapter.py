"""The adapter for SpatialVLA: packing, streams, taps, roles, cameras, actions.

Sequence: the picture's patches, beginning of sequence, instruction, new line. One stack has two streams, by
position: `backbone` is the prompt without the new line. `action` has the positions whose logits choose an action
token: the new line, then every token fed back but the last. Three tokens are a step, several steps a chunk.
"""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit._system.bounded_files import load_json
from probe_kit.errors import CheckpointError, InstructionError, ObservationError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.checkpoints.checkpoint import SMALL_FILES, chosen_dtype
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import read_weights
from probe_kit.hooks.contract.card import ARM
from probe_kit.hooks.contract.model import Policy, Tap
from probe_kit.hooks.contract.observation import Observation, checked_picture
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import IMAGE_ROLE, Site, Stream
from probe_kit.hooks.families.shared.action_statistics import ActionStatistics, open_or_closed
from probe_kit.hooks.families.shared.kinds import TOKENS
from probe_kit.hooks.families.shared.loading import DTYPES, Loaded, load_network
from probe_kit.hooks.families.shared.taps import Note, decoder_attention, decoder_tap, kept_prompt
from probe_kit.hooks.families.shared.text import SLOT, FileTokenizer, find_tokenizer, template_of
from probe_kit.hooks.families.shared.token_decoder import TokenDecoder, warn_of_unknown
from probe_kit.hooks.families.spatialvla.actions import STEP_TOKENS, ActionBins
from probe_kit.hooks.families.spatialvla.network import (
    Intrinsics,
    PictureSettings,
    SpatialVLAConfig,
    SpatialVLANetwork,
    build_spatialvla,
    is_camera,
    known_cameras,
    prepare_picture,
)
from probe_kit.models.checkpoint_files import SIGLIP_TOWER, rename_tensor, stored_statistics
from probe_kit.models.decoding import Decoded, Packed

PROCESSOR_FILE = "processor_config.json"


@dataclass(frozen=True, kw_only=True)
class LoadedSpatialVLA(Loaded[SpatialVLANetwork]):
    """A loaded network.

    Attributes:
        processor: The content of `processor_config.json`: bins, statistics, cameras.
    """

    processor: Mapping[str, Any]

    @property
    def config(self) -> SpatialVLAConfig:
        """The configuration of the network."""
        return self.network.config

    @property
    def processor_file(self) -> str:
        """The file named by errors about bins, statistics and cameras."""
        return str(self.folder / PROCESSOR_FILE)

    @property
    def chunk(self) -> int:
        """The number of steps that one inference plans.

        Raises:
            CheckpointError: If there are none.
        """
        steps = int(self.processor.get("action_chunk_size", 1))
        if steps < 1:
            raise CheckpointError(f"{self.processor_file}: action_chunk_size is {steps}; expected at least 1")
        return steps


def load_checkpoint(
    checkpoint: str, device: str, dtype: str | None, random_weights: bool, weights_seed: int = 0
) -> LoadedSpatialVLA:
    """Load a folder or hub id.

    Args:
        checkpoint: Folder or hub id.
        device: Device in torch's spelling, such as `cuda:0`.
        dtype: float32 or bfloat16; None takes what the checkpoint says.
        random_weights: Whether the weights are drawn instead of read.
        weights_seed: Seed of random weights.

    Raises:
        CheckpointError: For a folder that is not there, and for files that are missing or bad.
        WeightsError: For weights that are not exactly the network's.
        UsageError: For another dtype.
    """
    folder = checkpoint_folder(checkpoint)
    config = SpatialVLAConfig.from_folder(folder)
    processor = read_processor(folder)
    loaded = load_network(
        partial(build_spatialvla, config),
        lambda: read_weights(folder),
        checkpoint,
        folder,
        device,
        chosen_dtype(dtype, config.dtype, DTYPES),
        random_weights,
        weights_seed,
        name_in_module=lambda name: rename_tensor(name, SIGLIP_TOWER),
        finish=lambda network: network.embed_actions(),
    )
    return LoadedSpatialVLA(**vars(loaded), processor=processor)


def read_processor(folder: Path) -> dict[str, Any]:
    """The content of `processor_config.json`.

    Raises:
        CheckpointError: If it is missing.
    """
    file = folder / PROCESSOR_FILE
    if not file.is_file():
        raise CheckpointError(
            f"{file} is missing: it holds the action bins, statistics and cameras. Copy it from the model's page"
        )
    return dict(load_json(file))


# -- prompts --------------------------------------------------------------------------------------------------

PROMPTS = {"bare": SLOT, "question": f"What action should the robot take to {SLOT}?"}
"""The prompts of training and of the released evaluation (`bare`), and of the model's page (`question`)."""
_END = "\n"


@dataclass(frozen=True)
class Speech:
    """The way from an instruction to ids.

    Attributes:
        template: The prompt with a place for the instruction.
        lowercase: Whether the instruction is in lower case, as in training; in the released evaluation it is not.
        tokenizer_choice: Folder of another tokenizer; None for the checkpoint's.
    """

    config: SpatialVLAConfig
    folder: Path
    template: str
    lowercase: bool
    tokenizer_choice: str | None

    @classmethod
    def of(
        cls, config: SpatialVLAConfig, folder: Path, prompt: str | None, lowercase: bool, tokenizer: str | None
    ) -> "Speech":
        """Choose a prompt by name or template; see `template_of`."""
        return cls(config, folder, template_of(prompt or "bare", PROMPTS), lowercase, tokenizer)

    @cached_property
    def tokenizer(self) -> FileTokenizer:
        """The tokenizer of the checkpoint, or the chosen one.

        Raises:
            CheckpointError: For files that are missing, which it names, and for ids that are not this model's.
        """
        config = self.config
        tokenizer = find_tokenizer([self.folder], self.tokenizer_choice, config.beginning)
        for token, expected in (("<image>", config.image_token), ("<ACTION00000>", config.first_action)):
            if (ids := tokenizer.encode(token)[1:]) != [expected]:
                raise CheckpointError(
                    f"the tokenizer reads {token} as {ids}; the model expects {expected}. It belongs to "
                    "another checkpoint: take the tokenizer files from the model's own page"
                )
        return tokenizer

    def prompt(self, instruction: str) -> list[int]:
        """Return the ids of the whole prompt: the picture's places, beginning of sequence, text, new line.

        Raises:
            InstructionError: For text that the tokenizer reads as a picture or an action, or that takes the new
                line into itself. The model chooses its action there.
        """
        text = self.template.replace(SLOT, instruction.lower() if self.lowercase else instruction)
        ids = self.tokenizer.encode(text + _END)
        if max(ids) >= self.config.image_token:
            raise InstructionError(
                f"{text!r} holds a token that stands for a picture or an action; say it in words"
            )
        if ids[-1:] != self.tokenizer.encode(_END)[-1:]:
            raise InstructionError(
                f"the end of {text!r} merges with the new line behind it; leave out white space there"
            )
        return [self.config.image_token] * self.config.patches + ids


# -- the adapter ----------------------------------------------------------------------------------------------

DEFAULT_CHECKPOINT = "IPEC-COMMUNITY/spatialvla-4b-224-pt"
"""The checkpoint that is loaded where none is named."""
SCENE = "scene"
"""The name that asks for the camera of the observation."""
ENSEMBLE = 0.8
"""The exponent with which the client for SimplerEnv averages the plans of overlapping chunks."""


class SpatialVLA(TokenDecoder, Policy):
    """A loaded SpatialVLA.

    `steps` is the number of greedy tokens per inference; `captured` of them are captured by the stream `action`.
    """

    family: ClassVar[str] = "spatialvla"
    interventions = TOKENS
    added = MappingProxyType({"attention": "post_attention_layernorm", "mlp": "post_feedforward_layernorm"})
    """The norms of what the attention and the MLP of Gemma-2 put out, before it is added; SigLIP has none."""
    loaded: LoadedSpatialVLA
    network: SpatialVLANetwork

    def __init__(
        self,
        loaded: LoadedSpatialVLA,
        speech: Speech,
        statistics: ActionStatistics,
        camera: str,
        steps: int,
        captured: int,
        constrained: bool,
        ensemble: bool = False,
    ) -> None:
        super().__init__(loaded, steps, captured)
        self.speech, self.statistics = speech, statistics
        self.camera, self.constrained = camera, constrained
        self.ensemble = ENSEMBLE if ensemble else None
        self.bins = ActionBins.of(
            loaded.processor, self.config.first_action, self.config.actions, loaded.processor_file
        )
        self._preset = _preset(loaded, camera)
        self.tower: Any = self.network.vision_tower.vision_model
        seeing, vision = len(self.tower.encoder.layers) + 1, self.config.vision
        heads = int(vision.num_attention_heads)
        self.further_streams = {
            "vision": Stream("vision", seeing, int(vision.hidden_size), part="vision", heads=heads)
        }
        self.prompt_kv = kept_prompt(self.config.text)
        needed = self.config.depth is not None and self._preset is None
        self.card = loaded.card(
            self.family,
            self._settings(),
            tokenizer=speech.tokenizer_choice,
            notes=self._notes(),
            embodiment=f"{ARM}, units of {statistics.key}",
            chunk=steps // STEP_TOKENS,
            execute=1,
            needs=frozenset({"intrinsics"}) if needed else frozenset(),
            ensemble=self.ensemble,
        )

    def _settings(self) -> dict[str, str]:
        """Return every choice by its name."""
        return {
            "tokenizer": self.speech.tokenizer_choice or "the checkpoint's",
            "unnorm_key": self.statistics.key,
            "action_statistics": self.statistics.sha256,
            "action_bins": sha256_json(self.bins.content),
            "prompt": self.speech.template,
            "lowercase": str(self.speech.lowercase),
            "camera": self.camera,
            "constrained": str(self.constrained),
            "ensemble": str(self.ensemble),
            "steps": str(self.steps),
            "iterations": str(self.streams["action"].iterations),
        }

    def _notes(self) -> tuple[str, ...]:
        notes = [
            f"actions in the units and at the rate of {self.statistics.key}",
            f"prompt: {self.speech.template!r}{', lower case' if self.speech.lowercase else ''}",
        ]
        if self.constrained:
            notes.append("decoding limited to the slot of every token, which the original does not do")
        if self._preset is not None:
            notes.append(f"camera: that of {self.camera}, whatever takes the picture")
        return tuple(notes)

    # -- inputs ------------------------------------------------------------------------------------------

    @cached_property
    def picture_settings(self) -> PictureSettings:
        """The settings of resizing pictures."""
        return PictureSettings.of(self.config, self.loaded.folder)

    def pictures(self, observations: Sequence[Observation]) -> Tensor:
        """Return the pictures (B, 3, S, S) float32 in [0, 1].

        Raises:
            ObservationError: For a picture of another dtype or shape.
        """
        rows = [
            prepare_picture(checked_picture(observation.image), self.picture_settings)
            for observation in observations
        ]
        return torch.from_numpy(np.stack(rows)).to(self.loaded.device)

    def cameras(self, observations: Sequence[Observation]) -> Tensor:
        """Return float32 intrinsics (B, 3, 3) for the pictures as the model sees them.

        Raises:
            ObservationError: For a matrix that is no camera's.
        """
        rows = [self._camera(observation).at(self.config.side) for observation in observations]
        return torch.from_numpy(np.stack(rows)).to(self.loaded.device)

    def _camera(self, observation: Observation) -> Intrinsics:
        if self._preset is not None:
            return self._preset
        height, width = observation.image.shape[:2]
        if observation.intrinsics is None:  # only a model without depth gets this far
            return Intrinsics(np.eye(3), width, height)
        matrix = np.asarray(observation.intrinsics)
        if not is_camera(matrix):
            raise ObservationError(f"intrinsics are {matrix.tolist()}; expected an invertible 3 × 3 matrix")
        return Intrinsics(matrix, width, height)

    def prompt(self, instruction: str) -> list[int]:
        """Return the ids of a whole prompt, places for the picture first; see `Speech.prompt`."""
        return self.speech.prompt(instruction)

    def token_texts(self) -> tuple[str, ...]:
        """Return the text of every token by its id."""
        return self.speech.tokenizer.texts

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each whole prompt behind the picture."""
        return [tuple(self.prompt(instruction)[self.config.patches :]) for instruction in instructions]

    def pack(self, rows: Sequence[Sequence[int]]) -> Packed:
        """Return prompts of ids as a batch.

        Raises:
            InstructionError: For a prompt that is too long.
        """
        self.check_length(max(map(len, rows)))
        return Packed.of(rows, self.config.padding)

    @property
    def positions(self) -> int:
        """The most positions of a prompt and its output, and no more than Gemma-2's window.

        Half of its layers attend to no more.
        """
        window = self.config.text.sliding_window
        return min(super().positions, int(window)) if window else super().positions

    # -- acting ------------------------------------------------------------------------------------------

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return a chunk per observation; decoding is greedy, so the seeds change nothing. See the contract.

        A row is flagged if a token of its first step, the one that is executed, names no action.
        """
        self.check(observations, seeds)
        rows = [self.prompt(observation.instruction) for observation in observations]
        ids = self.generate(self.pictures(observations), self.cameras(observations), rows).ids.cpu().numpy()
        ids = ids.reshape(len(observations), -1, STEP_TOKENS)
        self.flagged = ~np.asarray(self.bins.is_action(ids[:, 0]).all(axis=-1))
        if self.flagged.any():
            warn_of_unknown()
        return open_or_closed(self.actions(ids))

    def actions(self, ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the actions (…, 7) of ids (…, 3) in the data set's units, the gripper as decoded."""
        return self.statistics.restore(self.bins.values(ids))

    def generate(
        self, pictures: Tensor, cameras: Tensor, rows: Sequence[Sequence[int]], fed: Tensor | None = None
    ) -> Decoded:
        """Return `steps` greedy tokens behind every prompt; one inference, as `capture` counts it.

        Args:
            pictures: (B, 3, S, S) float32 in [0, 1].
            cameras: (B, 3, 3) float32 intrinsics.
            rows: The ids of every prompt.
            fed: (B, steps - 1) ids that are fed back instead of those chosen; None feeds the chosen ones.
        """
        packed, device = self.pack(rows), self.loaded.device
        slots = [self.bins.slots[step % STEP_TOKENS] for step in range(self.steps)] if self.constrained else None
        with torch.inference_mode():
            features = self.network.look(pictures, cameras).features
            return self.network.decode(
                packed.ids.to(device), packed.mask.to(device), features, self.steps, slots, fed
            )

    def record_attention(self, note: Note) -> AbstractContextManager[None]:
        """Record the weights that Gemma-2's attention returns, which is eager for its soft cap."""
        return decoder_attention(self.decoder.layers, note, eager=True)

    # -- capture -----------------------------------------------------------------------------------------

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles of patches, beginning of sequence and text, with padding behind the shorter prompts."""
        rows = [self.prompt(observation.instruction)[:-1] for observation in observations]
        return self.roles_of([self._labels(row) for row in rows])

    def _labels(self, row: Sequence[int]) -> list[str]:
        special = self.speech.tokenizer.special
        picture = [IMAGE_ROLE] * self.config.patches
        return picture + ["special" if number in special else "language" for number in row[len(picture) :]]

    def patch_order(self) -> NDArray[np.int64]:
        """Return a token per patch, row by row; its place in space is added to it behind the tower."""
        return np.arange(self.config.patches)

    def vision_tap(self, site: Site) -> Tap:
        """Return the first norm of a block, the norm behind the last, or what a block adds."""
        return decoder_tap(self.tower.encoder.layers, self.tower.post_layernorm, site, entry="layer_norm1")


def _preset(loaded: LoadedSpatialVLA, camera: str) -> Intrinsics | None:
    if camera == SCENE:
        return None
    presets = known_cameras(loaded.processor, loaded.processor_file)
    if camera not in presets:
        raise UsageError(f"camera {camera!r} is neither {SCENE} nor one of the checkpoint's: {', '.join(presets)}")
    return presets[camera]


def check_spatialvla_words(
    checkpoint: str,
    instructions: Sequence[str],
    *,
    prompt: str | None = None,
    lowercase: bool = True,
    tokenizer: str | None = None,
    **_: Any,
) -> None:
    """Raise InstructionError for an instruction that cannot be read; see `Family.words`."""
    folder = checkpoint_folder(checkpoint, SMALL_FILES)
    speech = Speech.of(SpatialVLAConfig.from_folder(folder), folder, prompt, lowercase, tokenizer)
    for instruction in instructions:
        speech.prompt(instruction)


def load_spatialvla(
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    *,
    unnorm_key: str | None = None,
    prompt: str | None = None,
    lowercase: bool = True,
    camera: str = SCENE,
    iterations: str = "step",
    constrained: bool = False,
    ensemble: bool = False,
    tokenizer: str | None = None,
    weights_seed: int = 0,
) -> SpatialVLA:
    """Load SpatialVLA or one of its fine-tunes from a folder or hub id.

    The options are those of the family. Raises what `load_checkpoint` raises, too.

    Raises:
        UsageError: For an option that cannot be used, and for a data set that has to be chosen.
    """
    if iterations not in ("step", "chunk"):
        raise UsageError(f"iterations is {iterations!r}; expected step or chunk")
    loaded = load_checkpoint(checkpoint or DEFAULT_CHECKPOINT, device, dtype, random_weights, weights_seed)
    steps = STEP_TOKENS * loaded.chunk
    return SpatialVLA(
        loaded,
        Speech.of(loaded.config, loaded.folder, prompt, lowercase, tokenizer),
        choose_statistics(loaded, unnorm_key),
        camera,
        steps,
        STEP_TOKENS if iterations == "step" else steps,
        constrained,
        ensemble,
    )


def spatialvla_units(checkpoint: str, *, unnorm_key: str | None = None, **_: Any) -> str:
    """Return the data set whose units the actions get, and what says so; see `Family.units`."""
    folder = checkpoint_folder(checkpoint, SMALL_FILES)
    by_data_set, source = _statistics(folder, read_processor(folder))
    return f"{ActionStatistics.choose(by_data_set, unnorm_key, source).key}, from {source}"


def choose_statistics(loaded: LoadedSpatialVLA, key: str | None) -> ActionStatistics:
    """Return the statistics of data set `key`; without one, of the only data set there is.

    Raises:
        UsageError: For a key that is not there or has to be chosen.
        CheckpointError: For bad statistics.
    """
    by_data_set, source = _statistics(loaded.folder, loaded.processor)
    statistics = ActionStatistics.choose(by_data_set, key, source)
    if len(statistics.low) != 7:
        raise CheckpointError(
            f"{statistics.key} has actions of {len(statistics.low)} dimensions; SpatialVLA's tokens name 7. "
            "Choose another -M unnorm_key"
        )
    return statistics


def _statistics(folder: Path, processor: Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
    """Return per data set the statistics that un-normalise its actions, and what holds them.

    Raises:
        CheckpointError: If there are none.
    """
    file = str(folder / PROCESSOR_FILE)
    by_data_set, source = stored_statistics((folder,), processor.get("statistics") or {}, file)
    if not by_data_set:
        raise CheckpointError(
            f"{file} has no statistics: its actions have no physical unit. Copy the file from the model's page, "
            "or take the one that fine-tuning wrote"
        )
    return by_data_set, source
