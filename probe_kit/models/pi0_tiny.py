"""The embedded default: a pi0 of 0.6 million parameters, written as an ordinary lerobot checkpoint.

Dimensions follow the measured recipe of `design/models-pi0`, section 6 ("S"). The weights are random for
now; the file says so in its metadata, and every result made with them is marked.
"""

import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from safetensors.numpy import save_file as save_numpy
from safetensors.torch import save_file
from tokenizers import Regex, Tokenizer
from tokenizers.models import WordLevel
from tokenizers.normalizers import Lowercase
from tokenizers.pre_tokenizers import Sequence, Split
from tokenizers.processors import TemplateProcessing

from probe_kit.identity import sha256_json
from probe_kit.models.initialisation import initialise
from probe_kit.models.pi0 import GemmaSize, Pi0Size, SiglipSize, build_pi0
from probe_kit.suite.generators import vocabulary

_SPECIAL = ("<pad>", "<eos>", "<bos>", "<unk>", "\n")
WORDS = (*_SPECIAL, *vocabulary())
SIZE = Pi0Size(
    vlm=GemmaSize(width=96, depth=4, mlp_dim=192, num_heads=8, num_kv_heads=1, head_dim=16),
    expert=GemmaSize(width=64, depth=4, mlp_dim=128, num_heads=8, num_kv_heads=1, head_dim=16),
    vision=SiglipSize(hidden=64, layers=2, heads=4, inter=128, patch=8),
    vocab_size=-(-len(WORDS) // 64) * 64,
)
IMAGE_SIDE = 48
CHUNK = 8
TEXT_TOKENS = 16

# Spread of the scripted expert's actions and of the states it visits (metres, radians, openness): they give
# a policy with random weights movements of the right size.
_ACTION = ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5], [0.02, 0.02, 0.02, 0.05, 0.05, 0.05, 0.5])
_STATE = ([0.32, 0.03, 0.1, 0.0, 0.0, 0.0, 0.0, 0.5], [0.06, 0.09, 0.05, 0.1, 0.1, 0.1, 1.0, 0.5])


def random_checkpoint(seed: int = 0) -> Path:
    """Folder of the random checkpoint of this seed, written on first use.

    It lies in `$PROBE_KIT_CACHE` (default `~/.cache/probe_kit`) and is complete or absent: it is written
    aside and renamed.
    """
    cache = Path(os.environ.get("PROBE_KIT_CACHE", Path.home() / ".cache" / "probe_kit")) / "checkpoints"
    folder = cache / f"pi0-tiny-random-{seed}-{_recipe()[:12]}"
    if not folder.is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(dir=cache, prefix=".writing-"))
        write_checkpoint(aside, seed)
        _rename_unless_there(aside, folder)
    return folder


def _recipe() -> str:
    """Hash of everything the checkpoint is made from, so that no cache outlives a changed recipe."""
    return sha256_json([SIZE.to_json(), IMAGE_SIDE, CHUNK, TEXT_TOKENS, WORDS, _ACTION, _STATE])


def _rename_unless_there(aside: Path, folder: Path) -> None:
    try:
        aside.rename(folder)
    except OSError:
        shutil.rmtree(aside)
        if not folder.is_dir():
            raise


def write_checkpoint(folder: Path, seed: int) -> None:
    """Write config, dimensions, tokenizer, statistics and random weights in lerobot's layout."""
    config = _config()
    policy = build_pi0(config, SIZE)
    initialise(policy, seed)
    config.save_pretrained(folder)
    (folder / "dims.json").write_text(json.dumps(SIZE.to_json(), indent=1))
    _write_tokenizer(folder)
    _write_statistics(folder)
    save_file(
        {name: tensor.contiguous() for name, tensor in policy.state_dict().items()},
        folder / "model.safetensors",
        metadata={"format": "pt", "probe_kit.weights": f"random, seed {seed}"},
    )


def _config() -> PI0Config:
    return PI0Config(
        input_features={
            "observation.images.base": PolicyFeature(FeatureType.VISUAL, (3, IMAGE_SIDE, IMAGE_SIDE)),
            "observation.state": PolicyFeature(FeatureType.STATE, (8,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        normalization_mapping={
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        },
        device="cpu",
        push_to_hub=False,
        chunk_size=CHUNK,
        n_action_steps=CHUNK // 2,
        max_state_dim=8,
        max_action_dim=7,
        image_resolution=(IMAGE_SIDE, IMAGE_SIDE),
        tokenizer_max_length=TEXT_TOKENS,
    )


def _write_tokenizer(folder: Path) -> None:
    """A word-level tokenizer of the embedded suite's grammar."""
    tokenizer = Tokenizer(WordLevel({word: index for index, word in enumerate(WORDS)}, unk_token="<unk>"))
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = Sequence([Split(Regex("\n"), "isolated"), Split(" ", "removed")])
    tokenizer.post_processor = TemplateProcessing(single="<bos> $A", special_tokens=[("<bos>", 2)])
    tokenizer.add_special_tokens(["<pad>", "<eos>", "<bos>", "<unk>"])
    tokenizer.save(str(folder / "tokenizer.json"))
    card = {"tokenizer_class": "PreTrainedTokenizerFast", "model_max_length": TEXT_TOKENS}
    tokens = {f"{name}_token": f"<{name}>" for name in ("pad", "eos", "bos", "unk")}
    (folder / "tokenizer_config.json").write_text(json.dumps(card | tokens, indent=1))


def _write_statistics(folder: Path) -> None:
    arrays = {
        f"{feature}.{name}": np.array(values, np.float32)
        for feature, pair in (("action", _ACTION), ("observation.state", _STATE))
        for name, values in zip(("mean", "std"), pair, strict=True)
    }
    modes = {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}
    for pipeline, step in (("policy_preprocessor", "normalizer"), ("policy_postprocessor", "unnormalizer")):
        state_file = f"{pipeline}_step_0_{step}_processor.safetensors"
        save_numpy(arrays, folder / state_file)
        entry: dict[str, Any] = {
            "registry_name": f"{step}_processor",
            "config": {"eps": 1e-8, "norm_map": modes},
            "state_file": state_file,
        }
        (folder / f"{pipeline}.json").write_text(json.dumps({"name": pipeline, "steps": [entry]}, indent=1))
