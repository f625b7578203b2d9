"""The embedded VLM: a PaliGemma of the size of pi0-tiny's backbone, as an ordinary transformers checkpoint.

Its weights lie in `checkpoints/` beside this file, with a model card; `scripts/train_vlm_tiny.py` makes them.
"""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from transformers import PaliGemmaConfig

from probe_kit.models.embedded.pi0_tiny import IMAGE_SIDE, LOOKED_AT, SIZE
from probe_kit.models.embedded.words import END, IMAGE_TOKEN, SPECIAL, VOCABULARY, write_tokenizer
from probe_kit.models.initialisation import initialise
from probe_kit.models.paligemma.network import build_paligemma
from probe_kit.models.paligemma.pictures import CROP

MOST_TOKENS = 128
"""Of a whole prompt, the picture's 36 included."""
CAMERA_PICTURE = (480, 640)


def new_vlm_tiny(seed: int) -> Any:
    """A `PaliGemmaForConditionalGeneration` with seeded random weights, on the CPU, in eval mode."""
    network = build_paligemma(_config(), torch.float32, "cpu")
    initialise(network, seed)
    return network


def write_vlm_tiny(folder: Path, network: Any, note: str) -> None:
    """Write config, tokenizer, picture settings and weights in transformers' layout.

    note: what the weights are; it goes into the metadata of the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    network.config.save_pretrained(folder)
    (folder / "generation_config.json").write_text(json.dumps({"eos_token_id": END}, indent=1), encoding="utf-8")
    (folder / "preprocessor_config.json").write_text(json.dumps(_pictures(), indent=1), encoding="utf-8")
    write_tokenizer(folder, MOST_TOKENS)
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    del tensors["lm_head.weight"]  # tied
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt", "probe_kit.weights": note})


def _config() -> PaliGemmaConfig:
    text = {
        "model_type": "gemma",
        "hidden_size": SIZE.vlm.width,
        "intermediate_size": SIZE.vlm.mlp_dim,
        "num_hidden_layers": SIZE.vlm.depth,
        "num_attention_heads": SIZE.vlm.num_heads,
        "num_key_value_heads": SIZE.vlm.num_kv_heads,
        "head_dim": SIZE.vlm.head_dim,
        "vocab_size": VOCABULARY,
        "max_position_embeddings": MOST_TOKENS,
        "hidden_activation": "gelu_pytorch_tanh",
        "pad_token_id": SPECIAL.index("<pad>"),
        "bos_token_id": SPECIAL.index("<bos>"),
        "eos_token_id": END,
    }
    vision = {
        "model_type": "siglip_vision_model",
        "hidden_size": SIZE.vision.hidden,
        "intermediate_size": SIZE.vision.inter,
        "num_hidden_layers": SIZE.vision.layers,
        "num_attention_heads": SIZE.vision.heads,
        "patch_size": SIZE.vision.patch,
        "image_size": IMAGE_SIDE,
        "projection_dim": SIZE.vlm.width,
        "vision_use_head": False,
    }
    return PaliGemmaConfig(
        text_config=text,
        vision_config=vision,
        projection_dim=SIZE.vlm.width,
        hidden_size=SIZE.vlm.width,
        image_token_index=IMAGE_TOKEN,
        architectures=["PaliGemmaForConditionalGeneration"],
    )


def _pictures() -> dict[str, Any]:
    """SigLIP's own settings, and what part of a picture is looked at."""
    height, width = CAMERA_PICTURE
    top, column, rows, columns = LOOKED_AT
    return {
        "image_processor_type": "SiglipImageProcessor",
        "do_resize": True,
        "do_rescale": True,
        "rescale_factor": 1 / 255,
        "do_normalize": True,
        "image_mean": [0.5, 0.5, 0.5],
        "image_std": [0.5, 0.5, 0.5],
        "resample": 2,
        "size": {"height": IMAGE_SIDE, "width": IMAGE_SIDE},
        CROP: [top / height, column / width, rows / height, columns / width],
    }
