"""Checkpoints as transformers 5 saves them, and a program that saves them with the transformers that it finds.

    python saved_again.py JOBS.json

The file lists the arguments of `save_whole`, `save_lora` and `save_parts` behind the names of these functions. The
program imports nothing of this repository, so that it runs with another transformers in front of the path.
"""

import json
import re
import shutil
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

CLASSES = {
    "paligemma": ("PaliGemmaForConditionalGeneration", "PaliGemmaProcessor", "SiglipImageProcessor", None),
    "internvl": (
        "InternVLForConditionalGeneration", "InternVLProcessor", "GotOcr2ImageProcessor", "InternVLVideoProcessor"
    ),
    "qwen2.5-vl": (
        "Qwen2_5_VLForConditionalGeneration", "Qwen2_5_VLProcessor", "Qwen2VLImageProcessor",
        "Qwen2VLVideoProcessor",
    ),
    "qwen3-vl": (
        "Qwen3VLForConditionalGeneration", "Qwen3VLProcessor", "Qwen2VLImageProcessor", "Qwen3VLVideoProcessor"
    ),
}  # fmt: skip
"""Of each family whose network is transformers' own: network, processor, and processors of pictures and videos."""
INTERNVL_TOKENS = {
    "start_image_token": "<img>", "end_image_token": "</img>", "context_image_token": "<IMG_CONTEXT>",
    "video_token": "<|video_pad|>",
}  # fmt: skip

# -- layouts --------------------------------------------------------------------------------------------------

LANGUAGE = r"^(?:model\.)?language_model\.(?:model\.)?(?=layers|embed_tokens|norm)"
OUTSIDE = r"^(?:model\.)?(vision_tower|multi_modal_projector)\."
QWEN_LANGUAGE = r"^model\.(?:language_model\.)?(?=layers|embed_tokens|norm)"
LAYOUTS: dict[str, dict[str, tuple[tuple[str, str], ...]]] = {
    "paligemma": {
        "released": ((LANGUAGE, "language_model.model."), (OUTSIDE, r"\1.")),
        "the module's": ((LANGUAGE, "model.language_model."), (OUTSIDE, r"model.\1.")),
        "5.5": ((LANGUAGE, "model.language_model.model."), (OUTSIDE, r"model.\1.")),
        "5.24, from a configuration": (
            (LANGUAGE, "language_model.model."), (OUTSIDE, r"\1."),
            (r"vision_tower\.vision_model\.", "vision_tower."),
        ),
    },
    "internvl": {
        "released": ((LANGUAGE, "language_model.model."), (OUTSIDE, r"\1.")),
        "the module's": ((LANGUAGE, "model.language_model."), (OUTSIDE, r"model.\1.")),
        "5.5": ((LANGUAGE, "model.language_model.model."), (OUTSIDE, r"model.\1.")),
    },
    "qwen2.5-vl": {
        "released": ((QWEN_LANGUAGE, "model."), (r"^(?:model\.)?visual\.", "visual.")),
        "the module's": ((QWEN_LANGUAGE, "model.language_model."), (r"^(?:model\.)?visual\.", "model.visual.")),
        "5.5": ((QWEN_LANGUAGE, "model."), (r"^(?:model\.)?visual\.", "model.visual.")),
    },
}  # fmt: skip
"""The namings of weights by family; a slow test compares those of versions with what these versions write."""
SIGLIP = ((r"vision_tower\.vision_model\.", "vision_tower."),)
"""The shorter names that a SigLIP tower has in the module of transformers 5.24, also inside a policy's."""


def rename_weights(folder: Path, renames: Iterable[tuple[str, str]]) -> None:
    """Give the tensors of every file of weights in a folder other names."""
    from safetensors.torch import load_file, save_file

    def renamed(name: str) -> str:
        for pattern, replacement in renames:
            name = re.sub(pattern, replacement, name)
        return name

    for file in folder.glob("model*.safetensors"):
        save_file({renamed(name): tensor for name, tensor in load_file(file).items()}, file, {"format": "pt"})
    for index in folder.glob("*.index.json"):
        _change(index, lambda values: {
            **values, "weight_map": {renamed(name): file for name, file in values["weight_map"].items()}
        })  # fmt: skip


def _change(file: Path, change: Callable[[dict[str, Any]], Mapping[str, Any]]) -> None:
    file.write_text(json.dumps(change(json.loads(file.read_text(encoding="utf-8")))), encoding="utf-8")


def join_processor(folder: Path) -> None:
    """Move settings of pictures and videos into `processor_config.json`, as processors are saved since 5.4."""
    joined = folder / "processor_config.json"
    parts = {"image_processor": "preprocessor_config.json", "video_processor": "video_preprocessor_config.json"}
    content = json.loads(joined.read_text(encoding="utf-8")) if joined.is_file() else {}
    for part, name in parts.items():
        if (file := folder / name).is_file():
            content[part] = json.loads(file.read_text(encoding="utf-8"))
            file.unlink()
    joined.write_text(json.dumps(content), encoding="utf-8")


def _current_values(values: Any) -> Any:
    """The values of a configuration as transformers 5 writes them: `dtype`, `rope_parameters`."""
    if not isinstance(values, dict):
        return values
    current = {name: _current_values(value) for name, value in values.items()}
    if "torch_dtype" in current:
        current["dtype"] = current.pop("torch_dtype")
    rope = {**(current.pop("rope_scaling", None) or {}), **(current.get("rope_parameters") or {})}
    if "rope_theta" in current:
        rope["rope_theta"] = current.pop("rope_theta")
    if rope:
        current["rope_parameters"] = {"rope_type": "default", **rope}
    return current


def write_in_newest_layout(folder: Path) -> None:
    """Rewrite the files of transformers in a folder and below as 5.24 writes them: names and JSON, no numbers."""
    for file in sorted(folder.rglob("preprocessor_config.json")):
        join_processor(file.parent)
    for file in sorted(folder.rglob("config.json")):
        _change(file, lambda values: {**_current_values(values), "transformers_version": "5.24.0"}
                if "type" not in values else values)  # fmt: skip
    for file in sorted(folder.rglob("tokenizer_config.json")):
        template = json.loads(file.read_text(encoding="utf-8")).get("chat_template")
        if template:
            (file.parent / "chat_template.jinja").write_text(template, encoding="utf-8")
        special = file.parent / "special_tokens_map.json"
        special_tokens = json.loads(special.read_text(encoding="utf-8")) if special.is_file() else {}
        special.unlink(missing_ok=True)
        left_out = ("chat_template", "added_tokens_decoder")
        _change(file, lambda values, tokens=special_tokens, left_out=left_out: {  # type: ignore[misc]
            "backend": "tokenizers", "is_local": True, "local_files_only": True,
            **{name: token["content"] if isinstance(token, dict) else token for name, token in tokens.items()},
            **{name: value for name, value in values.items() if name not in left_out},
        })  # fmt: skip
    for checkpoint_folder in {file.parent for file in folder.rglob("model*.safetensors")}:
        rename_weights(checkpoint_folder, SIGLIP)


# -- the program ----------------------------------------------------------------------------------------------


def _load(family: str, source: Path) -> Any:
    import transformers

    return getattr(transformers, CLASSES[family][0]).from_pretrained(source)


def _save_processor(family: str, source: Path, out: Path) -> None:
    import transformers

    tokens = {"extra_special_tokens": INTERNVL_TOKENS} if family == "internvl" else {}
    tokenizer = transformers.AutoTokenizer.from_pretrained(source, **tokens)
    _, processor, pictures, videos = CLASSES[family]
    extra = {} if videos is None else {"video_processor": getattr(transformers, videos)()}
    image_processor = getattr(transformers, pictures).from_pretrained(source)
    getattr(transformers, processor)(
        image_processor=image_processor, tokenizer=tokenizer, **extra
    ).save_pretrained(out)


def save_whole(family: str, source: Path, out: Path, origin: str) -> None:
    """Save model, tokenizer and processor.

    origin: `loaded`, or `configured` for a network made from its configuration, as some training does.
    """
    network = _load(family, source)
    if origin == "configured":
        fresh = type(network)(type(network).config_class.from_pretrained(source))
        fresh.load_state_dict(network.state_dict())
        fresh.generation_config = network.generation_config
        network = fresh
    network.save_pretrained(out)
    _save_processor(family, source, out)


def save_lora(family: str, source: Path, out: Path) -> None:
    """Save an adapter, and beside it its merge by peft in the folder `OUT-merged`."""
    import torch
    from peft import LoraConfig, get_peft_model

    config = LoraConfig(
        r=2, lora_alpha=4, target_modules=r".*(q_proj|v_proj|fc1|qkv)", rank_pattern={r"layers\.1\..*q_proj": 3},
        alpha_pattern={"v_proj": 7}, use_rslora=True,
    )  # fmt: skip
    tuned = get_peft_model(_load(family, source), config)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, value in tuned.named_parameters():
            if "lora_" in name:
                value.copy_(0.1 * torch.randn(value.shape, generator=generator))
    tuned.save_pretrained(out)
    _change(out / "adapter_config.json", lambda values: {**values, "base_model_name_or_path": str(source)})
    merged = out.with_name(f"{out.name}-merged")
    tuned.merge_and_unload().save_pretrained(merged)
    for target in (out, merged):
        _save_processor(family, source, target)


def save_parts(folder: Path) -> None:
    """Save configuration, tokenizer and processor of a folder again, in place, each by the class that reads it."""
    import transformers

    config = transformers.AutoConfig.from_pretrained(folder)
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder)
    try:
        processor = transformers.AutoProcessor.from_pretrained(folder)
    except (OSError, ValueError, TypeError, AttributeError):
        processor = None
    for name in ("preprocessor_config.json", "video_preprocessor_config.json"):
        if processor is not None and hasattr(processor, "image_processor"):
            (folder / name).unlink(missing_ok=True)
    config.save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    if processor is not None:
        processor.save_pretrained(folder)


def copied(source: Path, to: Path) -> Path:
    """A copy of a checkpoint's folder that a test may change."""
    return Path(shutil.copytree(source, to))


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    KINDS = {"whole": save_whole, "lora": save_lora, "parts": save_parts}
    for kind, *arguments in json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")):
        typed = [Path(argument) if "/" in argument else argument for argument in arguments]
        KINDS[kind](*typed)
