"""Tiny pi0-FAST checkpoints: two tokenizers, quantiles in the processor files, and `dims.json`."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.torch import save_file
from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from tokenizers.normalizers import Lowercase, Replace
from tokenizers.normalizers import Sequence as Normalizers

from tests.hooks.families.pi0.pi05_checkpoints import HIGH, LEAST, LOW, MOST, write_tokenizer
from tests.support.lerobot_units import write_units
from tests.support.written_once import written_once

CHUNK, ACTIONS = 4, 7
GOLDEN = Path(__file__).parents[3] / "golden"
SKIPPED, FAST_TOKENS = 4, 320
"""Of the byte pairs' alphabet 256 are bytes."""
STEPS = 24
HEAD = "model.paligemma_with_expert.paligemma.lm_head.weight"


@written_once
def write_pi0_fast(
    folder: Path,
    seed: int = 0,
    cameras: Sequence[str] = ("base",),
    empty_cameras: int = 0,
    further_words: Sequence[str] = (),
    **fields: Any,
) -> Path:
    """A tiny pi0-FAST with random weights; `fields` go into its configuration."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig

    from probe_kit.hooks.families.pi0_fast.adapter import build_pi0_fast
    from probe_kit.hooks.families.shared.lerobot.paligemma import GemmaSize, PaliGemmaSize, SiglipSize
    from probe_kit.models.building import initialise

    fast = write_fast_tokenizer(folder / "fast")
    size = PaliGemmaSize(
        vlm=GemmaSize(width=32, depth=3, mlp_dim=48, num_heads=8, num_kv_heads=1, head_dim=8),
        vision=SiglipSize(hidden=24, layers=2, heads=3, inter=40, patch=8),
        vocab_size=write_text_tokenizer(folder, fast, further_words),
    )
    config = PI0FastConfig(
        input_features={
            **{f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 24, 40)) for name in cameras},
            "observation.state": PolicyFeature(FeatureType.STATE, (len(LOW),)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTIONS,))},
        device="cpu",
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        max_state_dim=10,
        max_action_dim=9,
        image_resolution=(32, 32),
        empty_cameras=empty_cameras,
        tokenizer_max_length=64,
        text_tokenizer_name=".",
        action_tokenizer_name="fast",
        max_decoding_steps=STEPS,
        max_action_tokens=STEPS,
        fast_skip_tokens=SKIPPED,
        **fields,
    )
    network = build_pi0_fast(config, size)
    initialise(network, seed)
    config.save_pretrained(folder)
    (folder / "dims.json").write_text(json.dumps(size.to_json()), encoding="utf-8")
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    write_units(folder, "observation.state", "QUANTILES", {"q01": LOW, "q99": HIGH})
    write_units(folder, "action", "QUANTILES", {"q01": LEAST, "q99": MOST})
    return folder


INSTRUCTIONS = ("put the cube on the red shape", "put the cube on the star")


def smooth_chunks(number: int, seed: int = 0) -> NDArray[np.float32]:
    """(number, CHUNK, ACTIONS) in [-1, 1]: lines between two random actions."""
    first, last = np.random.default_rng(seed).uniform(-1, 1, (2, number, 1, ACTIONS))
    return np.asarray(first + (last - first) * np.linspace(0, 1, CHUNK)[:, None], np.float32)


TRAINED = smooth_chunks(2, seed=1)
"""What `write_trained` answers to `INSTRUCTIONS`, up to rounding."""


def write_trained(folder: Path, steps: int = 400) -> Path:
    """The same, trained with lerobot's loss until it puts out a whole chunk for each of two instructions."""
    import torch
    from lerobot.policies.pi0_fast.modeling_pi0_fast import PI0FastPolicy

    from probe_kit.hooks.families.pi0_fast.adapter import Pi0Fast

    policy, rng = Pi0Fast.load(str(write_pi0_fast(folder))), np.random.default_rng(0)
    network: PI0FastPolicy = policy.network
    processor = fast_processor(folder / "fast")
    rows = [[policy.tokenizer.bos_token_id, *policy.action_text.ids(ids)] for ids in processor(TRAINED)]
    targets = torch.zeros((len(rows), STEPS), dtype=torch.long)
    for index, row in enumerate(rows):
        targets[index, : len(row)] = torch.tensor(row)
    masks = targets != 0
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    for _ in range(steps):
        state = rng.uniform(-1, 1, (len(rows), len(LOW))).astype(np.float32)
        text, mask = policy.tokenise(INSTRUCTIONS, state)
        pictures = torch.from_numpy(rng.uniform(-1, 1, (len(rows), 3, 32, 32)).astype(np.float32))
        present = torch.ones(len(rows), dtype=torch.bool)
        loss = network.model([pictures], [present], text, mask, targets, masks)["loss"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    return folder


def fast_processor(folder: Path) -> Any:
    """The FAST tokenizer in a folder as lerobot's own class, which encodes and decodes."""
    from lerobot.policies.molmoact2.molmoact2_hf_model.action_tokenizer import UniversalActionProcessor

    return UniversalActionProcessor.from_pretrained_local(str(folder))


def write_fast_tokenizer(folder: Path) -> int:
    """FAST's tokenizer as lerobot's `UniversalActionProcessor` trains it; the number of its ids.

    Copied from the golden reference where there is one: lerobot's class takes seconds to import.
    """
    if (recorded := GOLDEN / "pi0_fast" / "checkpoint" / "fast").is_dir():
        shutil.copytree(recorded, folder, dirs_exist_ok=True)
        return int(Tokenizer.from_file(str(folder / "tokenizer.json")).get_vocab_size())
    from lerobot.policies.molmoact2.molmoact2_hf_model.action_tokenizer import UniversalActionProcessor

    fitted = UniversalActionProcessor.fit(list(smooth_chunks(64)), vocab_size=FAST_TOKENS)
    folder.mkdir(parents=True, exist_ok=True)
    fitted.bpe_tokenizer.save_pretrained(folder)
    card = {"scale": fitted.scale, "vocab_size": fitted.vocab_size, "min_token": fitted.min_token}
    (folder / "processor_config.json").write_text(json.dumps(card), encoding="utf-8")
    return len(fitted.bpe_tokenizer)


def write_text_tokenizer(folder: Path, fast: int, further_words: Sequence[str] = ()) -> int:
    """That of pi0.5 with PaliGemma's last ids, which FAST's tokens stand for; the number of its ids."""
    write_tokenizer(folder, ["|", "Action", *further_words])
    path = folder / "tokenizer.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    words = content["model"]["vocab"]
    for kind, number in (("loc", fast), ("seg", SKIPPED)):
        words |= {f"<{kind}{index:04d}>": len(words) + index for index in range(number)}
    tokenizer = Tokenizer.from_str(json.dumps(content))
    tokenizer.model = WordLevel(words, unk_token="<unk>")
    tokenizer.normalizer = Normalizers([Lowercase(), Replace("action:", "Action:")])
    tokenizer.save(str(path))
    return len(words)
