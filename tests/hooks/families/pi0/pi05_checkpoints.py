"""Tiny pi0.5 checkpoints as lerobot 0.6 writes them: quantiles in the processor files, and `dims.json`."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from safetensors.torch import save_file
from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from tokenizers.normalizers import Lowercase
from tokenizers.pre_tokenizers import Digits, Punctuation, Split
from tokenizers.pre_tokenizers import Sequence as PreTokenizers
from tokenizers.processors import TemplateProcessing

from probe_kit.models.embedded.words import WORDS
from tests.support.lerobot_units import write_units
from tests.support.written_once import written_once

STATES, ACTIONS = 8, 7
LOW = np.array([0.1, -0.3, -0.1, -1.0, -1.0, -1.0, -1.0, 0.0], np.float32)
LEAST = np.array([-0.03, -0.04, -0.02, -0.08, -0.09, -0.2, 0.0], np.float32)
MOST = np.array([0.02, 0.05, 0.04, 0.06, 0.07, 0.25, 1.0], np.float32)
HIGH = np.array([0.6, 0.3, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0], np.float32)


@written_once
def write_pi05(
    folder: Path,
    seed: int = 0,
    cameras: Sequence[str] = ("base",),
    empty_cameras: int = 0,
    further_words: Sequence[str] = (),
) -> Path:
    """A tiny pi0.5 with random weights; norms, gates and the time network are not at their zeros of training."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.pi05.configuration_pi05 import PI05Config

    from probe_kit.hooks.families.pi0.network import Pi0Size, build_pi05
    from probe_kit.hooks.families.shared.lerobot.paligemma import GemmaSize, SiglipSize
    from probe_kit.models.building import initialise

    words = write_tokenizer(folder, further_words)
    size = Pi0Size(
        vlm=GemmaSize(width=32, depth=3, mlp_dim=48, num_heads=8, num_kv_heads=1, head_dim=8),
        expert=GemmaSize(width=24, depth=3, mlp_dim=40, num_heads=8, num_kv_heads=1, head_dim=8),
        vision=SiglipSize(hidden=24, layers=2, heads=3, inter=40, patch=8),
        vocab_size=words,
    )
    config = PI05Config(
        input_features={
            **{f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 24, 40)) for name in cameras},
            "observation.state": PolicyFeature(FeatureType.STATE, (STATES,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTIONS,))},
        device="cpu",
        chunk_size=4,
        n_action_steps=4,
        max_state_dim=10,
        max_action_dim=9,
        num_inference_steps=5,
        image_resolution=(32, 32),
        empty_cameras=empty_cameras,
        tokenizer_max_length=64,
    )
    network = build_pi05(config, size)
    initialise(network, seed)
    config.save_pretrained(folder)
    (folder / "dims.json").write_text(json.dumps(size.to_json()), encoding="utf-8")
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    head = "model.paligemma_with_expert.paligemma.lm_head.weight"
    tensors.pop("model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight")
    assert head in tensors  # lerobot stores the tied embedding once
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    write_units(folder, "observation.state", "QUANTILES", {"q01": LOW, "q99": HIGH})
    write_units(folder, "action", "QUANTILES", {"q01": LEAST, "q99": MOST})
    return folder


def write_tokenizer(folder: Path, further_words: Sequence[str] = ()) -> int:
    """Words, and numbers digit by digit, as Gemma's tokenizer has them; the number of its ids."""
    folder.mkdir(parents=True, exist_ok=True)
    prompt_words = ["task", "state", "action", *"0123456789", "-", ":", ",", ";", *further_words]
    vocabulary = list(dict.fromkeys([*WORDS, *prompt_words]))
    tokenizer = Tokenizer(WordLevel({word: index for index, word in enumerate(vocabulary)}, unk_token="<unk>"))
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = PreTokenizers(
        [Split("\n", "isolated"), Split(" ", "removed"), Punctuation("isolated"), Digits(individual_digits=True)]
    )
    tokenizer.add_special_tokens(["<pad>", "<eos>", "<bos>", "<unk>"])
    tokenizer.post_processor = TemplateProcessing(
        single="<bos> $A", special_tokens=[("<bos>", tokenizer.token_to_id("<bos>"))]
    )
    tokenizer.save(str(folder / "tokenizer.json"))
    card = {"tokenizer_class": "PreTrainedTokenizerFast", "bos_token": "<bos>", "eos_token": "<eos>",
            "pad_token": "<pad>", "unk_token": "<unk>"}  # fmt: skip
    (folder / "tokenizer_config.json").write_text(json.dumps(card), encoding="utf-8")
    return len(vocabulary)
