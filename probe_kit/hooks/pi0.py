"""The adapter for pi0: lerobot's `PI0Policy`, with our own loader, camera assembly, noise and units."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi0.modeling_pi0 import PI0Policy
from numpy.typing import NDArray
from torch import Tensor, nn
from transformers import AutoTokenizer

from probe_kit.errors import CheckpointError, InstructionError, ObservationError, UnknownSiteError
from probe_kit.hooks.checkpoint import checkpoint_folder
from probe_kit.hooks.policy import Observation, Policy, PolicyCard, Tap
from probe_kit.hooks.roles import PADDING, Roles
from probe_kit.hooks.sites import Site, Stream
from probe_kit.hooks.statistics import Normaliser, read_normaliser
from probe_kit.hooks.weights import Weights, load_weights, read_weights
from probe_kit.models.pi0 import Pi0Size, build_pi0, initialise
from probe_kit.models.pi0_keys import current_pi0_keys
from probe_kit.models.pi0_tiny import random_checkpoint

IMAGES = "observation.images."
# Never read at inference: the expert predicts actions, and the backbone's tokens are never decoded.
UNREAD = tuple(f"model.paligemma_with_expert.{part}.lm_head.weight" for part in ("paligemma", "gemma_expert"))


def load_pi0(
    checkpoint: str, device: str = "cpu", dtype: str | None = None, random_weights: bool = False
) -> "Pi0":
    """Load a lerobot pi0 checkpoint from a folder or hub id.

    dtype: float32 or bfloat16; default what the checkpoint's config says.
    random_weights: same architecture, tokenizer and statistics, but seeded random weights.
    Raises CheckpointError for missing files, WeightsError for weights that are not exactly the model's.
    """
    folder = checkpoint_folder(checkpoint)
    config = _read_config(folder)
    if dtype is not None:
        config.dtype = dtype
    network = build_pi0(config, _read_size(folder))
    if random_weights:
        initialise(network, seed=0)
        weights = Weights(network.state_dict(), f"random twin of {checkpoint}", random=True)
    else:
        weights = read_weights(folder)
    audit = load_weights(network, weights, current_pi0_keys(weights.tensors), UNREAD)
    config.device = device
    policy = Pi0(network.to(device), folder)
    policy.card = PolicyCard(
        family="pi0",
        checkpoint=checkpoint,
        weights_sha256=audit.sha256,
        random_weights=audit.random,
        parameters=audit.parameters,
        dtype=str(config.dtype),
        device=device,
        embodiment="7-DoF end-effector delta, one third-person camera",
        cameras=policy.cameras,
        chunk=config.chunk_size,
        execute=min(config.n_action_steps, config.chunk_size),
        notes=policy.notes,
        audit=audit.to_json(),
    )
    return policy


def load_pi0_tiny(
    checkpoint: str | None = None, device: str = "cpu", dtype: str | None = None, random_weights: bool = False
) -> "Pi0":
    """The embedded default: pi0 at 0.6 million parameters. Its own checkpoint holds random weights."""
    policy = load_pi0(checkpoint or str(random_checkpoint()), device, dtype, random_weights)
    policy.card = replace(policy.card, family="pi0-tiny", checkpoint=checkpoint or "embedded")
    return policy


def _read_config(folder: Path) -> PI0Config:
    if not (folder / "config.json").is_file():
        raise CheckpointError(f"{folder / 'config.json'} is missing; {folder} is not a lerobot checkpoint")
    config = PreTrainedConfig.from_pretrained(folder)
    if not isinstance(config, PI0Config):
        raise CheckpointError(f"{folder} holds a {config.type!r} policy; expected pi0. Pass the right --model")
    # Compiled graphs drop hooks, and real-time chunking mixes in actions of the chunk before.
    config.compile_model = False
    config.rtc_config = None
    return config


def _read_size(folder: Path) -> Pi0Size | None:
    for place in (folder, folder.parent):
        if (place / "dims.json").is_file():
            return Pi0Size.from_file(place / "dims.json")
    return None


class Pi0(Policy):
    """A loaded pi0 behind the Policy contract."""

    def __init__(self, network: PI0Policy, folder: Path) -> None:
        self.network, self.folder = network, folder
        self.config: PI0Config = network.config
        joint = network.model.paligemma_with_expert
        self._stacks: dict[str, Any] = {
            "backbone": joint.paligemma.model.language_model,
            "expert": joint.gemma_expert.model,
        }
        iterations = {"backbone": None, "expert": self.config.num_inference_steps}
        self.streams = {
            name: Stream(name, len(stack.layers) + 1, stack.config.hidden_size, iterations[name])
            for name, stack in self._stacks.items()
        }
        self.cameras = tuple(
            key.removeprefix(IMAGES) for key in self.config.image_features if "empty_camera" not in key
        )
        self.role_names = {
            "backbone": (f"image.{self.cameras[0]}", "language", "special", PADDING),
            "expert": ("state", "action"),
        }

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of results should know about how the observation was fed."""
        masked = self.cameras[1:]
        return (f"cameras without a picture, masked: {', '.join(masked)}",) if masked else ()

    # -- acting --------------------------------------------------------------------------------------

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """One chunk of actions per observation; see the contract."""
        if len(seeds) != len(observations):
            raise ObservationError(f"{len(observations)} observations but {len(seeds)} seeds")
        if self.config.output_features["action"].shape[0] != 7:
            raise CheckpointError(
                f"{self.folder} acts in {self.config.output_features['action'].shape[0]} dimensions; Act2Answer "
                "needs a 7-DoF end-effector delta policy"
            )
        batch = self._batch(observations)
        with torch.inference_mode():
            chunk = self.network.predict_action_chunk(batch, noise=self._noise(seeds))
        return self._action_units.restore(chunk.float().cpu().numpy())

    def _batch(self, observations: Sequence[Observation]) -> dict[str, Tensor]:
        device = self.config.device
        tokens, mask = self._tokenise([o.instruction for o in observations])
        images = np.stack([_checked_image(o.image) for o in observations])
        state = np.stack([np.asarray(o.state, np.float32) for o in observations])
        expected = self.config.input_features["observation.state"].shape[0]
        if state.shape[1] != expected:
            raise ObservationError(f"the state has {state.shape[1]} numbers; this checkpoint reads {expected}")
        return {
            # Only the first camera: pi0 masks the missing ones and appends them behind the present ones.
            f"{IMAGES}{self.cameras[0]}": torch.from_numpy(images).permute(0, 3, 1, 2).to(device).float() / 255,
            "observation.state": torch.from_numpy(self._state_units.normalise(state)).to(device),
            "observation.language.tokens": tokens.to(device),
            "observation.language.attention_mask": mask.to(device),
        }

    def _noise(self, seeds: Sequence[int]) -> Tensor:
        shape = (self.config.chunk_size, self.config.max_action_dim)
        rows = [torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        return torch.stack(rows).to(self.config.device)

    def _tokenise(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor]:
        """(B, tokenizer_max_length) ids and mask; never truncates and never drops a word."""
        length = self.config.tokenizer_max_length
        rows = [
            self._tokenizer(text if text.endswith("\n") else f"{text}\n")["input_ids"] for text in instructions
        ]
        for text, row in zip(instructions, rows, strict=True):
            if len(row) > length:
                raise InstructionError(
                    f"{text!r} is {len(row)} tokens; this checkpoint reads {length}. Shorten it"
                )
            if self._tokenizer.unk_token_id in row:
                raise InstructionError(
                    f"{text!r} has a word this checkpoint's tokenizer does not know; it would act without "
                    f"reading it. Tokens: {self._tokenizer.convert_ids_to_tokens(row)}"
                )
        tokens = torch.full((len(rows), length), self._tokenizer.pad_token_id or 0)
        mask = torch.zeros((len(rows), length), dtype=torch.bool)
        for index, row in enumerate(rows):
            tokens[index, : len(row)] = torch.tensor(row)
            mask[index, : len(row)] = True
        return tokens, mask

    # -- what belongs to the checkpoint besides weights ------------------------------------------------

    @cached_property
    def _tokenizer(self) -> Any:
        for place in (self.folder, self.folder.parent / "tokenizer"):
            if (place / "tokenizer.json").is_file():
                return AutoTokenizer.from_pretrained(place)
        name = "google/paligemma-3b-pt-224"
        try:
            return AutoTokenizer.from_pretrained(name)
        except OSError as error:
            raise CheckpointError(
                f"{self.folder} has no tokenizer.json and the gated {name} cannot be fetched. Run `hf auth "
                f"login`, or put tokenizer.json and tokenizer_config.json of {name} into the checkpoint folder"
            ) from error

    @cached_property
    def _state_units(self) -> Normaliser:
        return read_normaliser(self.folder, "policy_preprocessor", "observation.state", "STATE")

    @cached_property
    def _action_units(self) -> Normaliser:
        return read_normaliser(self.folder, "policy_postprocessor", "action", "ACTION")

    # -- listening -------------------------------------------------------------------------------------

    def tap(self, site: Site) -> Tap:
        """The first norm of the block the site enters, or the stack's final norm."""
        stream = self.streams.get(site.stream)
        if stream is None or site not in stream.sites():
            raise UnknownSiteError(f"pi0 has no site {site}; it has {', '.join(map(str, self.streams.values()))}")
        stack = self._stacks[site.stream]
        last = site.layer == len(stack.layers)
        module: nn.Module = stack.norm if last else stack.layers[site.layer].input_layernorm
        return Tap(module, fires=stream.iterations or 1)

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Prefix: every camera's patches, then the language; suffix: the state, then the action chunk."""
        tokens, mask = self._tokenise([o.instruction for o in observations])
        special = torch.isin(tokens, torch.tensor(self._tokenizer.all_special_ids))
        patches = self._patches_per_camera
        images = [f"image.{self.cameras[0]}"] * patches
        masked = [PADDING] * patches * (len(self.config.image_features) - 1)
        backbone = []
        for row_mask, row_special in zip(mask.tolist(), special.tolist(), strict=True):
            language = [
                PADDING if not valid else "special" if marker else "language"
                for valid, marker in zip(row_mask, row_special, strict=True)
            ]
            backbone.append(Roles.from_labels([*images, *masked, *language]))
        suffix = Roles.from_labels(["state", *["action"] * self.config.chunk_size])
        return {"backbone": backbone, "expert": [suffix] * len(observations)}

    @cached_property
    def _patches_per_camera(self) -> int:
        vision = self.network.model.paligemma_with_expert.paligemma.model.vision_tower.vision_model
        return int(vision.embeddings.num_patches)


def _checked_image(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ObservationError(f"image is {image.dtype} {image.shape}; expected uint8 (H, W, 3)")
    return image
