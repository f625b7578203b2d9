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
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.eo1.processor_eo1 import EO1ConversationTemplateStep, EO1QwenProcessorStep
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.errors import CheckpointError, InstructionError
from probe_kit.hooks.checkpoints.folders import inside_or_hub
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.views import PADDING
from probe_kit.hooks.families.eo1 import INTERVENTIONS
from probe_kit.hooks.families.shared.lerobot.features import IMAGES, STATE
from probe_kit.hooks.families.shared.lerobot.packed import PackedBatch, PackedPolicy, Tokens, chat_labels
from probe_kit.hooks.families.shared.lerobot.pipelines import PREPROCESSOR, check_same, saved_steps
from probe_kit.hooks.families.shared.lerobot.policy import checked_steps
from probe_kit.hooks.families.shared.lerobot.stacks import Stack, TokenStack
from probe_kit.hooks.families.shared.prompt_kv import kept_prompt
from probe_kit.models.lerobot.eo1 import build_eo1, chat_step, flow_actions

TEMPLATE, PROCESSOR = "eo1_conversation_template_processor", "eo1_qwen_processor"
_VLM = "model.vlm_backbone."
_HEAD, _EMBEDDING = f"{_VLM}lm_head.weight", f"{_VLM}model.language_model.embed_tokens.weight"


class Eo1(PackedPolicy):
    """A loaded EO-1."""

    family = "eo1"
    config_type = "eo1"
    known_steps = (TEMPLATE, PROCESSOR)
    interventions = INTERVENTIONS
    unread = (_HEAD,)
    tied: ClassVar[Mapping[str, str]] = {_EMBEDDING: _HEAD}

    other_roles: ClassVar[tuple[str, ...]] = ("language", "state", "special")
    suffix_roles = ("action",)

    def __init__(self, network: Any, folder: Path, checkpoint: str) -> None:
        super().__init__(network, folder, checkpoint)
        self.passages = network.model.prompt_kv
        self.prompt_kv = kept_prompt(network.model.vlm_backbone.config.text_config)

    @classmethod
    def current_values(cls, values: dict[str, Any], path: Path) -> dict[str, Any]:
        """Raise CheckpointError for a file without the sizes of its vision-language model."""
        if values.get("vlm_config") is None:
            raise CheckpointError(f"{path} has no vlm_config, the sizes of its Qwen2.5-VL. Save it with lerobot")
        return values

    @classmethod
    def parse_config(cls, folder: Path, evaluation: Any) -> Any:
        """lerobot's configuration, with what the processor files say: lerobot packs as they do."""
        config = super().parse_config(folder, evaluation)
        saved = {step.name: step.config for step in saved_steps(folder, PREPROCESSOR)}
        template = saved.get(TEMPLATE, {})
        features = template.get("input_features") or {}
        pictures = [name for name, feature in features.items() if feature["type"] == "VISUAL"] or None
        expected = {"chunk_size": config.chunk_size, "input_features": list(config.image_features)}
        check_same(folder, TEMPLATE, {**template, "input_features": pictures}, expected)
        names = ("image_min_pixels", "image_max_pixels", "use_fast_processor")
        config.packing = {name: getattr(config, name) for name in names} | dict(saved.get(PROCESSOR, {}))
        processor = str(config.packing.get("processor_name", config.vlm_base))
        config.processor_folder = inside_or_hub(folder, processor)
        return config

    @classmethod
    def build(cls, config: Any, folder: Path) -> nn.Module:
        """lerobot's policy of the size that the configuration has."""
        del folder
        if config.dtype == "auto":
            config.dtype = str(config.vlm_backbone_config.dtype or "float32").removeprefix("torch.")
        network: nn.Module = build_eo1(config)
        return network

    def parts(self) -> dict[str, Path]:
        """The processor's folder."""
        return {"vlm": self.config.processor_folder}

    @cached_property
    def packing(self) -> EO1QwenProcessorStep:
        """lerobot's step that reads a chat."""
        return chat_step(self.config.processor_folder, self.config.packing)

    @cached_property
    def tokenizer(self) -> Any:
        """The vision-language model's, with the tokens of states and actions."""
        return self.packing._processor.tokenizer

    def pack(self, observations: Sequence[Observation], state: NDArray[np.float32]) -> PackedBatch:
        """See the base; also for a text that holds one of the chat's own marks, or no word."""
        tasks = [observation.instruction for observation in observations]
        for task in tasks:
            marks = [mark for mark in self.tokenizer.get_added_vocab() if mark in task]
            if marks or not task.strip():
                raise InstructionError(
                    f"{task!r} holds {marks[0] if marks else 'no word'}; give it in plain words"
                )
        pictures = {
            f"{IMAGES}{camera}": self._pictures(camera, observations).cpu() for camera in self.shown_cameras
        }
        features = {key: self.config.image_features[key] for key in pictures}
        template = EO1ConversationTemplateStep(features, self.config.chunk_size)
        content, chat = TransitionKey.COMPLEMENTARY_DATA, {TransitionKey.OBSERVATION: pictures}
        packed = self.packing(template({**chat, content: {"task": tasks}}))[content]
        inputs = {name: torch.as_tensor(values) for name, values in packed.items() if name != "task"}
        return PackedBatch({**inputs, STATE: torch.from_numpy(state)}, self._labelled(inputs))

    def _labelled(self, packed: Mapping[str, Tensor]) -> list[Tokens]:
        """Ids and roles of every row, up to the actions."""
        begin, end, picture = self.tokenizer.convert_tokens_to_ids(["<|state_end|>", "<|vla|>", "<|image_pad|>"])
        state, action = int(packed["state_token_id"]), int(packed["action_token_id"])
        rows = []
        for ids, mask in zip(packed["input_ids"].tolist(), packed["attention_mask"].tolist(), strict=True):
            prompt, pictures = ids[: ids.index(action)], (f"image.{camera}" for camera in self.shown_cameras)
            labels = chat_labels(prompt, pictures, picture, (begin, end), state)
            labels = [label if valid else PADDING for label, valid in zip(labels, mask, strict=False)]
            rows.append(list(zip(prompt, labels, strict=True)))
        return rows

    def denoise(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """See the base; lerobot's own sampling makes no graph."""
        marks = {name: int(batch[name]) for name in ("state_token_id", "action_token_id")}
        return flow_actions(self.network, {**batch, **marks}, noise)

    def _stacks(self) -> dict[str, Stack]:
        decoder = self.network.model.vlm_backbone.model.language_model
        steps = checked_steps(int(self.config.num_denoise_steps), self.folder)
        shared = (decoder.layers, decoder.norm, int(decoder.config.hidden_size))
        return {"backbone": TokenStack(*shared, None), "expert": TokenStack(*shared, steps, first=1)}

    def watched(self) -> dict[str, nn.Module]:
        """The velocity."""
        return {"velocity": self.network.model.action_out_proj}
