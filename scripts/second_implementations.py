"""Compare golden references of pi0.5 and MolmoAct2 with a second implementation, Intel's physicalai-train.

    uv pip install --no-deps physicalai-train==0.3.0 physicalai==0.3.0
    uv pip install --no-deps lightning lightning-utilities torchmetrics jsonargparse loguru
    python scripts/second_implementations.py

Its dependencies exclude ours. Only its networks are imported; packages for export and simulation are stubbed.
The networks get the weights and the prepared inputs of `tests/golden`. The script prints the largest difference of
each quantity, and fails above 1e-5.
"""

import json
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from safetensors.torch import load_file

GOLDEN = Path(__file__).parents[1] / "tests" / "golden"
TOLERANCE = 1e-5
_UNUSED = ("gym_pusht", "openvino", "openvino_tokenizers", "onnx", "onnxscript", "pymunk", "executorch")


class _Stub:
    """Stands for any class or function of a package that is not used here."""

    def __class_getitem__(cls, _: Any) -> type:
        return cls


class _Stubs(MetaPathFinder, Loader):
    """Packages that physicalai imports and its networks do not use."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        """A stub for every module of an unused package."""
        del path, target
        return ModuleSpec(name, self, is_package=True) if name.split(".")[0] in _UNUSED else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """A module that has every name."""
        module = ModuleType(spec.name)
        module.__path__ = []

        def attribute(name: str) -> type:
            if name.startswith("__"):
                raise AttributeError(name)
            return _Stub

        module.__getattr__ = attribute  # type: ignore[method-assign]
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Nothing is left to do."""


def pi05() -> dict[str, float]:
    """From prepared pictures and tokens to the padded actions."""
    from physicalai.policies.pi05 import model as theirs

    folder = GOLDEN / "pi05"
    sizes, config = (
        json.loads((folder / "checkpoint" / name).read_text(encoding="utf-8"))
        for name in ("dims.json", "config.json")
    )
    paligemma, configurations = theirs.PaliGemmaForConditionalGenerationWithPiGemma, theirs.CONFIG_MAPPING

    def sized(config: Any) -> Any:
        config.text_config.vocab_size, tower = sizes["vocab_size"], config.vision_config
        config.image_token_index, tower.projection_dim = sizes["vocab_size"], sizes["vlm"]["width"]
        names = {"hidden": "hidden_size", "layers": "num_hidden_layers", "heads": "num_attention_heads",
                 "inter": "intermediate_size", "patch": "patch_size"}  # fmt: skip
        for field_name, name in names.items():
            setattr(tower, name, sizes["vision"][field_name])
        return paligemma(config=config)

    class Configurations:
        def __getitem__(self, kind: str) -> Any:
            configuration = configurations[kind]
            return (
                (lambda **options: configuration(**{**options, "vocab_size": sizes["vocab_size"]}))
                if kind == "gemma"
                else configuration
            )

    def gemma(variant: str) -> Any:
        return theirs.GemmaVariantConfig(**sizes["vlm" if variant == "gemma_2b" else "expert"])

    with (
        patch.object(theirs, "get_gemma_config", gemma),
        patch.object(theirs, "CONFIG_MAPPING", Configurations()),
        patch.object(theirs, "PaliGemmaForConditionalGenerationWithPiGemma", sized),
    ):
        names = ("chunk_size", "max_action_dim", "num_inference_steps", "tokenizer_max_length")
        network = theirs.Pi05Model(
            {}, image_resolution=tuple(config["image_resolution"]), **{name: config[name] for name in names}
        ).eval()
    tensors = _tensors(folder)
    head = "paligemma_with_expert.paligemma.lm_head.weight"
    tensors["paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"] = tensors[head]
    lacking = network.load_state_dict(tensors, strict=False)  # a time of its own distillation, which adds zero
    assert not lacking.unexpected_keys
    assert all(name.startswith("target_time_mlp") for name in lacking.missing_keys)
    reference = _reference(folder)
    inputs = (reference["prep_images"], reference["prep_image_masks"].bool(), reference["in_lang_tokens"],
              reference["in_lang_mask"].bool())  # fmt: skip
    valid = reference["prefix_pad"].bool()
    embedded, padded, _ = network.embed_prefix(*inputs)
    assert torch.equal(padded, valid)
    actions = network.sample_actions(*inputs, noise=reference["in_noise"].clone())
    return {
        "prefix_embs": _apart(embedded[valid], reference["prefix_embs"][valid]),
        "actions_padded": _apart(actions, reference["actions_padded"]),
    }


def molmoact2() -> dict[str, float]:
    """From ids and pixels to the actions.

    In theirs, the expert reads the marks that end a turn; in lerobot's it does not. They get lerobot's mask.
    """
    from physicalai.policies.molmoact2.model import MolmoAct2Model

    from probe_kit.hooks import Observation
    from probe_kit.hooks.families.molmoact2.adapter import MolmoAct2

    folder = GOLDEN / "molmoact2"
    ours, reference = MolmoAct2.load(str(folder / "checkpoint")), _reference(folder)
    lerobots, config = ours.network._backbone(), ours.network.model.config
    fields = {
        **_fields(config.text_config, "", ("hidden_size", "num_attention_heads", "num_key_value_heads", "head_dim",
            "vocab_size", "additional_vocab_size", "qkv_bias", "num_hidden_layers", "intermediate_size",
            "rope_theta", "use_qk_norm", "qk_norm_type")),
        **_fields(config.vit_config, "vision_", ("hidden_size", "intermediate_size", "num_hidden_layers",
            "num_attention_heads", "num_key_value_heads", "head_dim")),
        **_fields(config.vit_config, "", ("image_default_input_size", "image_patch_size", "image_num_pos")),
        **_fields(config.adapter_config, "adapter_", ("vit_layers", "hidden_size", "num_attention_heads",
            "num_key_value_heads", "head_dim", "intermediate_size", "text_hidden_size")),
        **_fields(config.action_expert_config, "action_expert_", ("hidden_size", "num_layers", "num_heads",
            "mlp_ratio", "ffn_multiple_of", "timestep_embed_dim")),
    }  # fmt: skip
    network = MolmoAct2Model(**fields, image_patch_id=config.image_patch_id).eval().backbone
    network.load_state_dict(_tensors(folder))
    with np.load(folder / "reference.npz") as arrays:
        rows = zip(arrays["in_image_image"], arrays["in_raw_state"], arrays["in_tasks"], strict=True)
        batch = ours.batch([Observation(image, state, str(task)) for image, state, task in rows])
    model_inputs = ours.network._model_inputs(batch)
    names = ("input_ids", "pixel_values", "image_token_pooling", "image_grids", "image_num_crops")
    images, pooling = lerobots.merge_visual_inputs(**{name: model_inputs[name] for name in names})
    text = {name: batch[name] for name in ("input_ids", "attention_mask", "token_type_ids")}
    inputs = {**text, "images": images, "token_pooling": pooling}
    embedded = network.model.build_input_embeddings(text["input_ids"], images, pooling)
    states = [part.transpose(1, 2).flatten(2) for pair in network.model.encode(**inputs) for part in pair]
    with (
        patch.object(network.model, "_encoder_attention_mask", lerobots._get_encoder_attention_mask),
        patch.object(torch, "randn", lambda *_, **__: reference["in_noise"].clone()),
    ):
        actions = network.model.generate_actions_from_inputs(
            **inputs, action_dim_is_pad=batch["action_dim_is_pad"], action_horizon=reference["in_noise"].shape[1],
            num_steps=len(reference["velocity"]), sample_noise=True,
        )  # fmt: skip
    return {
        "backbone_resid, first": _apart(embedded, reference["backbone_resid"][0]),
        "keys": _apart(torch.stack(states[::2]), reference["keys"]),
        "values": _apart(torch.stack(states[1::2]), reference["values"]),
        "actions": _apart(actions[..., : reference["actions"].shape[-1]], reference["actions"]),
    }


def _fields(config: SimpleNamespace, prefix: str, names: Sequence[str]) -> dict[str, Any]:
    values = {name: getattr(config, name) for name in names}
    return {
        f"{prefix}{name}": tuple(value) if isinstance(value, list) else value for name, value in values.items()
    }


def _tensors(folder: Path) -> dict[str, torch.Tensor]:
    """The weights under the names of the network without lerobot's policy around it."""
    stored = load_file(folder / "checkpoint" / "model.safetensors")
    return {name.removeprefix("model."): tensor for name, tensor in stored.items()}


def _reference(folder: Path) -> dict[str, torch.Tensor]:
    with np.load(folder / "reference.npz") as arrays:
        return {name: torch.from_numpy(arrays[name]) for name in arrays.files if arrays[name].dtype.kind != "U"}


def _apart(theirs: torch.Tensor, recorded: torch.Tensor) -> float:
    assert theirs.shape == recorded.shape
    return float((theirs - recorded).abs().max())


def main() -> None:
    """Print the differences."""
    sys.meta_path.insert(0, _Stubs())
    worst = 0.0
    with torch.inference_mode():
        for family in (pi05, molmoact2):
            for quantity, apart in family().items():
                print(f"{family.__name__}  {quantity}  {apart:.1e}")
                worst = max(worst, apart)
    if worst > TOLERANCE:
        raise SystemExit(f"a difference of {worst:.1e} is over {TOLERANCE:.0e}")


if __name__ == "__main__":
    main()
