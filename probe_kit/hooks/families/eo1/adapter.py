"""The adapter for EO-1.

Prefix: a chat with every picture, the state as one token, and the instruction. Suffix: the action chunk. One
decoder runs over the prefix once, then over the chunk at every step of the flow.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.errors import CheckpointError, InstructionError
from probe_kit.hooks.checkpoints.checkpoint import SMALL_FILES, side_files
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.views import PADDING
from probe_kit.hooks.families.eo1 import INTERVENTIONS
from probe_kit.hooks.families.shared.lerobot.evaluation import AS_STORED, Evaluation
from probe_kit.hooks.families.shared.lerobot.flow import DenoisingPolicy
from probe_kit.hooks.families.shared.lerobot.pipelines import PREPROCESSOR, saved_steps
from probe_kit.hooks.families.shared.lerobot.policy import IMAGES, STATE, checked_steps
from probe_kit.hooks.families.shared.lerobot.stacks import Stack, TokenStack
from probe_kit.hooks.families.shared.prompt_kv import kept_prompt
from probe_kit.models.lerobot.eo1 import Packing, build_eo1, flow_actions

TEMPLATE, PROCESSOR = "eo1_conversation_template_processor", "eo1_qwen_processor"
_VLM = "model.vlm_backbone."
_HEAD, _EMBEDDING = f"{_VLM}lm_head.weight", f"{_VLM}model.language_model.embed_tokens.weight"


class Eo1(DenoisingPolicy):
    """A loaded EO-1."""

    family = "eo1"
    config_type = "eo1"
    known_steps = (TEMPLATE, PROCESSOR)
    interventions = INTERVENTIONS
    unread = (_HEAD,)

    other_roles: ClassVar[tuple[str, ...]] = ("language", "state", "special")
    suffix_roles = ("action",)
    masked_cameras = 0

    def __init__(self, network: Any, folder: Path) -> None:
        super().__init__(network, folder)
        self.passages = network.model.prompt_kv
        self.prompt_kv = kept_prompt(self._vlm.config.text_config)

    @property
    def _vlm(self) -> Any:
        return self.network.model.vlm_backbone

    # -- loading -----------------------------------------------------------------------------------------

    @classmethod
    def current_values(cls, values: dict[str, Any], path: Path) -> dict[str, Any]:
        """Raise CheckpointError for a file without the sizes of its vision-language model."""
        if values.get("vlm_config") is None:
            raise CheckpointError(f"{path} has no vlm_config, the sizes of its Qwen2.5-VL. Save it with lerobot")
        return values

    @classmethod
    def parse_config(cls, folder: Path, evaluation: Evaluation) -> Any:
        """lerobot's configuration, with what the processor files say: lerobot packs as they do."""
        config = super().parse_config(folder, evaluation)
        saved = {step.name: step.config for step in saved_steps(folder, PREPROCESSOR)}
        template = saved.get(TEMPLATE, {})
        keys = [
            key for key, feature in (template.get("input_features") or {}).items() if feature["type"] == "VISUAL"
        ]
        expected = {"chunk_size": config.chunk_size, "pictures": list(config.image_features)}
        packed = {
            "chunk_size": template.get("chunk_size", config.chunk_size),
            "pictures": keys or expected["pictures"],
        }
        if packed != expected:
            raise CheckpointError(f"{folder}: its step {TEMPLATE} packs {packed}; config.json says {expected}")
        names = ("image_min_pixels", "image_max_pixels", "use_fast_processor")
        config.packing = {name: getattr(config, name) for name in names} | dict(saved.get(PROCESSOR, {}))
        processor = str(config.packing.get("processor_name", config.vlm_base))
        inside = folder / processor
        config.processor_folder = inside if inside.is_dir() else checkpoint_folder(processor, SMALL_FILES)
        return config

    @classmethod
    def build(cls, config: Any, folder: Path) -> nn.Module:
        """lerobot's policy of the size that the configuration has."""
        del folder
        if config.dtype == "auto":
            config.dtype = str(config.vlm_backbone_config.dtype or "float32").removeprefix("torch.")
        network: nn.Module = build_eo1(config)
        return network

    @classmethod
    def current_keys(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return tensors by current names: of the tied embeddings a file may hold either name."""
        renamed = dict(tensors)
        if _HEAD in renamed:
            renamed.setdefault(_EMBEDDING, renamed[_HEAD])
        return renamed

    def side_files(self) -> dict[str, Path]:
        """The files, and those of the processor."""
        return {**super().side_files(), **side_files(self.config.processor_folder, "vlm/")}

    # -- the prompt --------------------------------------------------------------------------------------

    @cached_property
    def packing(self) -> Packing:
        """lerobot's packing."""
        return Packing(self.config.processor_folder, int(self.config.chunk_size), self.config.packing)

    @cached_property
    def tokenizer(self) -> Any:
        """The vision-language model's, with the tokens of states and actions."""
        return self.packing.tokenizer

    def batch(
        self, observations: Sequence[Observation], state: NDArray[np.float32] | None = None
    ) -> dict[str, Tensor]:
        """Return a batch in lerobot's keys. state: (B, numbers) as the network reads them."""
        numbers = torch.from_numpy(self.state(observations) if state is None else state)
        packed = {**self._packed_of(observations), STATE: numbers}
        return {name: tensor.to(self.config.device) for name, tensor in packed.items()}

    def _packed_of(self, observations: Sequence[Observation]) -> dict[str, Tensor]:
        """The chats of observations; see `_packed`."""
        pictures = {
            f"{IMAGES}{camera}": self._pictures(camera, observations).cpu() for camera in self.shown_cameras
        }
        return self._packed(pictures, [observation.instruction for observation in observations])

    def _packed(self, pictures: Mapping[str, Tensor], tasks: Sequence[str]) -> dict[str, Tensor]:
        """Raises InstructionError for a text that holds one of the chat's own marks, or none."""
        for task in tasks:
            marks = [mark for mark in self.tokenizer.get_added_vocab() if mark in task]
            if marks or not task.strip():
                raise InstructionError(
                    f"{task!r} holds {marks[0] if marks else 'no word'}; give it in plain words"
                )
        packed = self.packing.batch(pictures, tasks)
        return {name: torch.as_tensor(values) for name, values in packed.items()}

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each chat without its picture."""
        blank = {f"{IMAGES}{self.cameras[0]}": torch.zeros(len(instructions), 3, 56, 56)}
        rows = self._labelled(self._packed(blank, instructions))
        return [tuple(token for token, label in row if label in ("language", "special")) for row in rows]

    def _labelled(self, packed: Mapping[str, Tensor]) -> list[list[tuple[int, str]]]:
        """Ids and roles of every row, up to the actions."""
        number = self.tokenizer.convert_tokens_to_ids
        begins, ends, picture = number("<|state_end|>"), number("<|vla|>"), number("<|image_pad|>")
        state, action = int(packed["state_token_id"]), int(packed["action_token_id"])
        rows = []
        for ids, valid in zip(packed["input_ids"].tolist(), packed["attention_mask"].tolist(), strict=True):
            row: list[tuple[int, str]] = []
            words, cameras = False, iter(self.shown_cameras)
            for token, real in zip(ids[: ids.index(action)], valid, strict=False):
                if token == picture and (not row or row[-1][0] != picture):
                    camera = next(cameras)
                role = f"image.{camera}" if token == picture else "state" if token == state else "special"
                words = words and token != ends
                row.append((token, PADDING if not real else "language" if words else role))
                words = words or token == begins
            rows.append(row)
        return rows

    @classmethod
    def check_words(cls, checkpoint: str, instructions: Sequence[str], evaluation: Evaluation = AS_STORED) -> None:
        """Raise InstructionError as `batch` would, from configuration and tokenizer alone."""
        cls._text_reader(checkpoint, evaluation).token_ids(instructions)

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Roles from the packing itself."""
        rows = self._labelled(self._packed_of(observations))
        prompts = [Roles.from_labels([label for _, label in row]) for row in rows]
        return {"backbone": prompts, "expert": [Roles.from_labels(self.suffix_labels())] * len(rows)}

    def prefix_labels(self, language: Sequence[str]) -> list[str]:
        """The packing says every position."""
        return list(language)

    def suffix_labels(self) -> list[str]:
        """The chunk."""
        return ["action"] * int(self.config.chunk_size)

    # -- acting and capture ------------------------------------------------------------------------------

    def denoise(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """See the base; lerobot's own sampling makes no graph."""
        marks = {name: int(batch[name]) for name in ("state_token_id", "action_token_id")}
        return flow_actions(self.network, {**batch, **marks}, noise)

    @property
    def noise_shape(self) -> tuple[int, int]:
        """Actions of a chunk, and the widest action."""
        return self.config.chunk_size, self.config.max_action_dim

    def _show(self, cameras: tuple[str, ...]) -> None:
        self.shown_cameras, self.further_streams = cameras, {}
        images = tuple(f"image.{camera}" for camera in cameras)
        self.role_names = {"backbone": (*images, *self.other_roles, PADDING), "expert": self.suffix_roles}

    def _stacks(self) -> dict[str, Stack]:
        decoder = self.network.model.vlm_backbone.model.language_model
        steps = checked_steps(int(self.config.num_denoise_steps), self.folder)
        shared = (decoder.layers, decoder.norm, int(decoder.config.hidden_size))
        return {"backbone": TokenStack(*shared, None), "expert": TokenStack(*shared, steps, first=1)}

    def watched(self) -> dict[str, nn.Module]:
        """The velocity."""
        return {"velocity": self.network.model.action_out_proj}
