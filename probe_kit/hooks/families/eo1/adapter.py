"""The adapter for EO-1, on lerobot's own `EO1Policy` at the size that a checkpoint has.

Prefix: a chat with every picture, the state as one token, and the instruction. Suffix: the action chunk. One
decoder runs over the prefix once, then over the chunk at every step of the flow.

Source: arXiv 2508.21112 (EO-1), through lerobot's `EO1Policy`.
"""

import logging
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, cast

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.eo1 import processor_eo1
from lerobot.policies.eo1.configuration_eo1 import EO1Config
from lerobot.policies.eo1.modeling_eo1 import EO1Policy
from lerobot.policies.eo1.processor_eo1 import EO1ConversationTemplateStep, EO1QwenProcessorStep
from numpy.typing import NDArray
from torch import Tensor, nn
from transformers import Qwen2_5_VLProcessor

from probe_kit.errors import CheckpointError, InstructionError
from probe_kit.hooks.checkpoints.folders import inside_or_hub
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import PADDING
from probe_kit.hooks.families.eo1 import INTERVENTIONS
from probe_kit.hooks.families.shared.kinds import IMAGES, STATE
from probe_kit.hooks.families.shared.lerobot.flow import PackedPolicy, Tokens, chat_labels
from probe_kit.hooks.families.shared.lerobot.pipelines import check_same, step_fields
from probe_kit.hooks.families.shared.lerobot.policy import checked_steps
from probe_kit.hooks.families.shared.qwen.network import qwen2_5_vl_config
from probe_kit.hooks.families.shared.taps import Stack, kept_prompt, token_stack
from probe_kit.models.building import build_empty, building_device, fill_rotary, replace_attributes
from probe_kit.models.checkpoint_files import load_pretrained
from probe_kit.models.decoding import PromptKV


def build_eo1(config: EO1Config, device: str = "cpu") -> EO1Policy:
    """Build an `EO1Policy` in eval mode with uninitialised weights; `config.dtype` is that of the Qwen2.5-VL."""
    config.device = building_device(device)
    config.pretrained_path = config.pretrained_path or Path()  # else lerobot downloads the weights of Qwen2.5-VL
    policy = cast(EO1Policy, build_empty(lambda: EO1Policy(config), torch.float32, config.device))
    vlm: Any = policy.model.vlm_backbone
    vlm.to(getattr(torch, config.dtype))
    fill_rotary(vlm)
    prompt_kv = PromptKV(int(vlm.config.text_config.num_hidden_layers))
    policy.model.prompt_kv = prompt_kv

    def send(_: nn.Module, __: Any, keywords: Mapping[str, Any], output: Any) -> None:
        if keywords.get("pixel_values") is not None:  # the prompt; steps of the flow read no picture
            prompt_kv(output.past_key_values.layers)

    vlm.model.register_forward_hook(send, with_kwargs=True)
    return policy


def full_size_eo1() -> EO1Policy:
    """Build EO-1 on Qwen2.5-VL-3B, on the meta device."""
    config = EO1Config(
        device="cpu",
        dtype="float32",
        vlm_config=qwen2_5_vl_config("3B").to_dict(),
        input_features={"observation.images.image": PolicyFeature(FeatureType.VISUAL, (3, 224, 224))},
    )
    return build_eo1(config, "meta")


def chat_step(folder: Path, fields: Mapping[str, Any]) -> EO1QwenProcessorStep:
    """Build lerobot's step that reads a chat.

    Args:
        folder: The folder of the processor's files.
        fields: The fields of the saved step.

    Raises:
        CheckpointError: For files without a chat template.
    """
    logging.getLogger("transformers.processing_utils").addFilter(_is_news)
    safely = SimpleNamespace(from_pretrained=partial(load_pretrained, Qwen2_5_VLProcessor))
    with replace_attributes(processor_eo1, {"Qwen2_5_VLProcessor": safely}):
        step = EO1QwenProcessorStep(**{**fields, "processor_name": str(folder)})
    if step._processor.chat_template is None:
        raise CheckpointError(f"{folder} has no chat_template, and EO-1 reads a chat. Take Qwen2.5-VL's own files")
    return step


def _is_news(record: logging.LogRecord) -> bool:
    """Whether transformers says something else than, at every chat, how lerobot should give its keywords."""
    return "processor_kwargs" not in record.getMessage()


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

    def __init__(self, network: Any, folder: Path, checkpoint: str) -> None:
        super().__init__(network, folder, checkpoint)
        self.passages = network.model.prompt_kv
        self.prompt_kv = kept_prompt(network.model.vlm_backbone.config.text_config)

    @classmethod
    def current_values(cls, values: dict[str, Any], path: Path) -> dict[str, Any]:
        """Return the fields as they are.

        Raises:
            CheckpointError: For a file without the sizes of its vision-language model.
        """
        if values.get("vlm_config") is None:
            raise CheckpointError(f"{path} has no vlm_config, the sizes of its Qwen2.5-VL. Save it with lerobot")
        return values

    @classmethod
    def parse_config(cls, folder: Path, evaluation: Any) -> Any:
        """Return lerobot's configuration, with what the processor files say: lerobot packs as they do."""
        config = super().parse_config(folder, evaluation)
        saved = step_fields(folder)
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
    def build(cls, config: Any, folder: Path) -> Any:
        """Build lerobot's policy of the size that the configuration has."""
        del folder
        if config.dtype == "auto":
            config.dtype = str(config.vlm_backbone_config.dtype or "float32").removeprefix("torch.")
        return build_eo1(config)

    def parts(self) -> dict[str, Path]:
        """Return the processor's folder."""
        return {"vlm": self.config.processor_folder}

    @cached_property
    def packing(self) -> EO1QwenProcessorStep:
        """The step of lerobot that reads a chat."""
        return chat_step(self.config.processor_folder, self.config.packing)

    @cached_property
    def tokenizer(self) -> Any:
        """The tokenizer of the vision-language model, with the tokens of states and actions."""
        return self.packing._processor.tokenizer

    def pack(
        self, observations: Sequence[Observation], state: NDArray[np.float32]
    ) -> tuple[dict[str, Tensor], list[Tokens]]:
        """Return inputs and prompts as the base does.

        Raises:
            InstructionError: Also for a text that holds one of the chat's own marks, or no word.
        """
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
        return {**inputs, STATE: torch.from_numpy(state)}, self._labelled(inputs)

    def _labelled(self, packed: Mapping[str, Tensor]) -> list[Tokens]:
        """Return ids and roles of every row, up to the actions."""
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
        """Return what lerobot's sampling, which makes no graph, puts out from the noise it would draw."""
        marks = {name: int(batch[name]) for name in ("state_token_id", "action_token_id")}
        self.network.model.sample_noise = lambda *_: noise
        try:
            return cast(Tensor, self.network.predict_action_chunk({**batch, **marks}))
        finally:
            del self.network.model.sample_noise

    def _stacks(self) -> dict[str, Stack]:
        decoder = self.network.model.vlm_backbone.model.language_model
        steps = checked_steps(int(self.config.num_denoise_steps), self.folder)
        shared = (decoder.layers, decoder.norm, int(decoder.config.hidden_size))
        return {"backbone": token_stack(*shared, None), "expert": token_stack(*shared, steps, first=1)}

    def recorded_modules(self) -> dict[str, nn.Module]:
        """Return the module of the velocity."""
        return {"velocity": self.network.model.action_out_proj}
