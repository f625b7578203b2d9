"""Record a golden reference of pi0, pi0.5, pi0-FAST or MolmoAct2: what lerobot's own code puts out.

The checkpoint is a tiny one.

    uv run python scripts/record_reference.py CHECKPOINT FOLDER --cameras base

Nothing of probe_kit's hooks or adapters is used. lerobot's policy is built, filled and called as it is, and the
streams come from lerobot's own blocks, called one after the other. The script fails unless the actions of those
calls equal those of `predict_action_chunk`. `probe-kit verify FAMILY FOLDER` compares the adapter with it.
"""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lerobot
import numpy as np
import torch
import transformers
from golden_folder import reference_parser, write_reference
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi0_fast import modeling_pi0_fast
from lerobot.policies.pi05 import modeling_pi05
from safetensors.torch import load_file
from torch import Tensor
from transformers import AutoTokenizer

from probe_kit.hooks.families.pi0.network import Pi0Size
from probe_kit.hooks.families.shared.lerobot.paligemma import PaliGemmaSize, resize_network
from probe_kit.models.building import replace_attributes

MODULES: dict[str, Any] = {"pi0": modeling_pi0, "pi05": modeling_pi05, "pi0_fast": modeling_pi0_fast}
POLICIES: dict[str, Callable[[Any], Any]] = {
    "pi0": modeling_pi0.PI0Policy,
    "pi05": modeling_pi05.PI05Policy,
    "pi0_fast": modeling_pi0_fast.PI0FastPolicy,
}
WEIGHTS = {"pi0_fast": "tiny weights, trained until their tokens are whole chunks (`tests/support`)"}
CAPTURED = 10
"""Action tokens of pi0-FAST of which the streams are recorded."""
TASKS = ("put the cube on the red shape", "put the cube on the star")
EMBEDDING = "model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
HEAD = "model.paligemma_with_expert.paligemma.lm_head.weight"


def lerobots_policy(checkpoint: Path) -> Any:
    """The policy of lerobot with the checkpoint's weights, through torch's strict loading alone."""
    config: Any = PreTrainedConfig.from_pretrained(checkpoint)
    config.compile_model, config.device = False, "cpu"
    if config.type == "pi0_fast":
        config.text_tokenizer_name = str(checkpoint)
        size = PaliGemmaSize.from_file(checkpoint / "dims.json")
        with resize_network(modeling_pi0_fast, size, config), packaged_fast(checkpoint):
            policy: Any = POLICIES[config.type](config)
    else:
        with resize_network(MODULES[config.type], Pi0Size.from_file(checkpoint / "dims.json"), config):
            policy = POLICIES[config.type](config)
    tensors = load_file(checkpoint / "model.safetensors")
    tensors.setdefault(EMBEDDING, tensors[HEAD])
    lacking = policy.load_state_dict(tensors, strict=False)
    unused = {f"model.paligemma_with_expert.{part}.lm_head.weight" for part in ("paligemma", "gemma_expert")}
    if lacking.unexpected_keys or set(lacking.missing_keys) - unused:
        raise SystemExit(f"other tensors than the network's: {lacking}")
    return policy.eval()


@contextmanager
def packaged_fast(checkpoint: Path) -> Iterator[None]:
    """Inside, pi0-FAST's tokenizer is the class that lerobot ships for MolmoAct2, instead of remote code."""
    from lerobot.policies.molmoact2.molmoact2_hf_model.action_tokenizer import UniversalActionProcessor

    def read(name: str, **_: Any) -> Any:
        return UniversalActionProcessor.from_pretrained_local(str(checkpoint / name))

    with replace_attributes(modeling_pi0_fast, {"AutoProcessor": SimpleNamespace(from_pretrained=read)}):
        yield


def stack(
    model: Any, entering: Tensor, mask: Tensor, positions: Tensor, **block_options: Any
) -> tuple[Tensor, Tensor]:
    """(L + 1, B, T, D) entering each block and the norm, and (B, T, D) behind the norm."""
    model.config._attn_implementation = "eager"
    condition = block_options.get("adarms_cond")
    rotary, stream, streams = model.rotary_emb(entering, positions), entering, [entering.clone()]
    for block in model.layers:
        stream = block(
            stream, attention_mask=mask, position_ids=positions, position_embeddings=rotary, **block_options
        )
        streams.append(stream.clone())
    return torch.stack(streams), model.norm(stream, condition)[0]


def record(policy: Any, batch: dict[str, Tensor], noise: Tensor) -> dict[str, np.ndarray]:
    """Every quantity of one inference; see `probe_kit.hooks.families.shared.lerobot.outputs`."""
    model, joint = policy.model, policy.model.paligemma_with_expert
    module = MODULES[policy.config.type]
    state = [policy.prepare_state(batch)] if policy.config.type == "pi0" else []
    images, image_masks = policy._preprocess_images(batch)
    tokens, token_mask = batch["observation.language.tokens"], batch["observation.language.attention_mask"]
    outputs: dict[str, Tensor] = {"prep_images": torch.stack(images), "prep_image_masks": torch.stack(image_masks)}
    if state:
        outputs["prep_state"] = state[0]
    outputs["vision_resid"] = torch.stack([vision_streams(joint, image) for image in images])

    embedded, pad, attends = model.embed_prefix(images, image_masks, tokens, token_mask)
    positions = torch.cumsum(pad, dim=1) - 1
    mask = module.prepare_attention_masks_4d(module.make_att_2d_masks(pad, attends))
    cache = transformers.DynamicCache()
    outputs |= {"prefix_embs": embedded.clone(), "prefix_pad": pad, "prefix_position_ids": positions}
    outputs["backbone_resid"], outputs["backbone_final_norm"] = stack(
        joint.paligemma.model.language_model, embedded, mask, positions, past_key_values=cache
    )

    steps, moved = policy.config.num_inference_steps, noise
    columns: dict[str, list[Tensor]] = {
        "expert_resid": [],
        "expert_final_norm": [],
        "velocity": [],
        "x_t": [noise],
    }
    for step in range(steps):
        time = torch.full((len(noise),), 1 - step / steps)
        suffix, suffix_pad, suffix_attends, condition = model.embed_suffix(*state, moved, time)
        before = pad[:, None, :].expand(len(pad), suffix.shape[1], pad.shape[1])
        visible = torch.cat([before, module.make_att_2d_masks(suffix_pad, suffix_attends)], dim=2)
        places = pad.sum(-1)[:, None] + torch.cumsum(suffix_pad, dim=1) - 1
        block_options = {} if condition is None else {"adarms_cond": condition}
        resid, normed = stack(
            joint.gemma_expert.model, suffix, module.prepare_attention_masks_4d(visible), places,
            past_key_values=module.clone_past_key_values(cache), **block_options,
        )  # fmt: skip
        velocity = model.action_out_proj(normed[:, -policy.config.chunk_size :])
        moved = moved - velocity / steps
        for name, value in zip(columns, (resid, normed, velocity, moved), strict=True):
            columns[name].append(value)
    outputs |= {name: torch.stack(values) for name, values in columns.items()}
    outputs["actions_padded"] = moved
    outputs["actions"] = policy.predict_action_chunk(batch, noise=noise)
    apart = float((outputs["actions"] - moved[..., : outputs["actions"].shape[-1]]).abs().max())
    if apart > 1e-6:
        raise SystemExit(f"lerobot's blocks, called one by one, give actions that are off by {apart:.3g}")
    return {name: value.detach().numpy() for name, value in outputs.items()}


def record_tokens(policy: Any, batch: dict[str, Tensor]) -> dict[str, np.ndarray]:
    """Every quantity of one inference of pi0-FAST; see `Pi0Fast.further_outputs`."""
    model, joint = policy.model, policy.model.paligemma_with_expert
    decoder, mask_of = joint.paligemma.model.language_model, modeling_pi0_fast.prepare_attention_masks_4d
    images, image_masks = policy._preprocess_images(batch)
    tokens, token_mask = batch["observation.language.tokens"], batch["observation.language.attention_mask"]
    outputs: dict[str, Tensor] = {"prep_images": torch.stack(images)}
    outputs["vision_resid"] = torch.stack([vision_streams(joint, image) for image in images])
    rows, ones = len(tokens), torch.ones((len(tokens), 1), dtype=torch.bool)
    begin = torch.full((rows, 1), policy._paligemma_tokenizer.bos_token_id)
    entering, pad, attends, _, _ = model.embed_prefix_fast(
        images, image_masks, torch.cat([tokens, begin], dim=1), torch.cat([token_mask, ones], dim=1)
    )
    cache, places = transformers.DynamicCache(), torch.cumsum(pad, dim=1) - 1
    columns: dict[str, list[Tensor]] = {"action_resid": [], "action_final_norm": [], "logits": []}
    drawn_tokens: list[Tensor] = []
    end = policy._paligemma_tokenizer.convert_tokens_to_ids("|")
    while not drawn_tokens or not bool((torch.stack(drawn_tokens) == end).any(dim=0).all()):
        resid, normed = stack(decoder, entering, mask_of(attends), places, past_key_values=cache)
        if not drawn_tokens:
            outputs |= {"prefix_pad": pad[:, :-1], "backbone_resid": resid[:, :, :-1]}
            outputs["backbone_final_norm"] = normed[:, :-1]
        logits = joint.paligemma.lm_head(normed[:, -1])
        for name, value in zip(columns, (resid[:, :, -1:], normed[:, -1:], logits), strict=True):
            columns[name].append(value)
        drawn_tokens.append(logits.argmax(dim=-1))
        if len(drawn_tokens) == policy.config.max_decoding_steps:
            break
        entering, pad = joint.embed_language_tokens(drawn_tokens[-1][:, None]), torch.cat([pad, ones], dim=1)
        places, attends = pad.sum(dim=1, keepdim=True) - 1, pad[:, None]
    outputs |= {name: torch.stack(values[:CAPTURED]) for name, values in columns.items()}
    outputs["logits"] = torch.stack(columns["logits"])
    outputs["tokens"] = torch.stack(drawn_tokens, dim=1)
    theirs = model.sample_actions_fast_kv_cache(
        images, image_masks, tokens, token_mask, policy.config.max_decoding_steps
    )
    if not torch.equal(theirs[:, : len(drawn_tokens)], outputs["tokens"]):
        raise SystemExit("lerobot's blocks, called one by one, put out other tokens than lerobot's sampling")
    outputs["actions"] = policy.predict_action_chunk(batch)
    return {name: value.detach().numpy() for name, value in outputs.items()}


def record_layers(checkpoint: Path, config: Any, seed: int) -> dict[str, np.ndarray]:
    """Every quantity of one inference of MolmoAct2; see `MolmoAct2.further_outputs`.

    The instructions are equally long, because lerobot counts positions from its padding on.
    """
    from lerobot.policies.molmoact2.processor_molmoact2 import make_molmoact2_pre_post_processors

    from probe_kit.hooks.families.molmoact2.adapter import lerobots_policy, network_config

    checkpoint_path, rng = checkpoint / config.checkpoint_path, np.random.default_rng(seed)
    policy = lerobots_policy(config, network_config(checkpoint_path), checkpoint_path)
    policy.load_state_dict(load_file(checkpoint / "model.safetensors"))
    config.action_mode, config.dataset_feature_names = "continuous", {"action": [*"xyzabc", "gripper"]}
    low, high = quantiles(checkpoint, "preprocessor", "observation.state")
    least, most = quantiles(checkpoint, "postprocessor", "action")
    statistics = {"observation.state": {"q01": low, "q99": high}, "action": {"q01": least, "q99": most}}
    tensors = {
        key: {name: torch.from_numpy(array) for name, array in rows.items()} for key, rows in statistics.items()
    }
    before, behind = make_molmoact2_pre_post_processors(config, tensors)
    tasks = ("put the cube on the star", "put the cube on the moon")
    raw = rng.uniform(low, high, (len(tasks), len(low))).astype(np.float32)
    pictures = rng.integers(0, 256, (len(tasks), 24, 40, 3), np.uint8)
    batch = before(
        {
            "observation.images.image": torch.from_numpy(pictures).permute(0, 3, 1, 2),
            "observation.state": torch.from_numpy(raw),
            "task": list(tasks),
        }
    )
    recorded: dict[str, Any] = {name: batch[name] for name in ("input_ids", "attention_mask", "pixel_values")}
    backbone, inputs = policy._backbone(), policy._model_inputs(batch)
    recorded["vision_resid"] = tower_streams(backbone, inputs)
    outputs = backbone(**inputs, use_cache=True, output_hidden_states=True)
    recorded["backbone_resid"] = torch.stack(outputs.hidden_states[:-1])
    recorded["backbone_final_norm"] = outputs.last_hidden_state
    states = backbone._extract_kv_states(outputs.past_key_values)
    recorded |= {
        name: torch.stack([entry[part] for entry in states]) for part, name in enumerate(("keys", "values"))
    }
    expert, steps = backbone.action_expert, config.num_inference_steps
    moved = torch.randn((len(tasks), config.chunk_size, 32), generator=torch.Generator().manual_seed(seed))
    recorded["in_noise"] = moved
    padded = batch["action_dim_is_pad"]
    moved = moved.masked_fill(padded[:, None], 0)
    context = expert.prepare_context(
        encoder_kv_states=states,
        encoder_attention_mask=backbone._get_encoder_attention_mask(inputs["input_ids"], inputs["attention_mask"]),
        batch_size=len(tasks), seq_len=config.chunk_size, device=moved.device, dtype=moved.dtype,
    )  # fmt: skip
    columns: dict[str, list[Tensor]] = {"expert_resid": [], "expert_final_norm": [], "velocity": []}
    for step in range(steps):
        condition = expert._time_conditioning(torch.full((len(tasks),), step / steps))
        stream, entering = expert.action_embed(moved), []
        for block, kv in zip(expert.blocks, context.kv_contexts, strict=True):
            entering.append(stream)
            stream = block(
                stream, condition, cross_kv=kv, attn_mask=context.cross_mask, rope_cache=context.rope_cache
            )
        velocity = expert.final_layer(stream, condition)
        moved = (moved + velocity / steps).masked_fill(padded[:, None], 0)
        values = (torch.stack([*entering, stream]), expert.final_layer.norm(stream), velocity)
        for name, value in zip(columns, values, strict=True):
            columns[name].append(value)
    recorded |= {name: torch.stack(values) for name, values in columns.items()}
    generator = torch.Generator().manual_seed(seed)
    recorded["actions"] = policy.predict_action_chunk(
        batch, generator=generator, inference_action_mode="continuous"
    )
    apart = float((recorded["actions"] - moved[..., : len(least)]).abs().max())
    if apart > 1e-6:
        raise SystemExit(f"lerobot's blocks, called one by one, give actions that are off by {apart:.3g}")
    recorded["actions_unnormalized"] = behind(recorded["actions"])
    arrays = {name: value.detach().numpy() for name, value in recorded.items()}
    return arrays | {"in_raw_state": raw, "in_image_image": pictures, "in_tasks": np.array(tasks)}


def tower_streams(backbone: Any, inputs: dict[str, Tensor]) -> Tensor:
    """(L, crops, N, D) entering each block of MolmoAct2's tower."""
    visual = backbone.vision_backbone
    crops, _ = backbone.merge_visual_inputs(
        **{name: inputs[name] for name in ("input_ids", "pixel_values", "image_token_pooling", "image_grids")},
        image_num_crops=inputs["image_num_crops"],
    )
    pixels = torch.round((crops + 1) * 0.5 * 255).clamp(0, 255) / 255 * 2 - 1
    stream = visual.image_vit.patch_embedding(pixels.flatten(0, 1))
    stream, streams = visual.image_vit.add_pos_emb(stream, visual.image_vit.config.image_num_patch), []
    for block in visual.image_vit.transformer.resblocks:
        streams.append(stream)
        stream = block(stream)
    return torch.stack(streams)


def vision_streams(joint: Any, image: Tensor) -> Tensor:
    """(L + 1, B, N, D): the embeddings, then what each block of the tower puts out."""
    tower = joint.paligemma.model.vision_tower.vision_model
    stream, streams = tower.embeddings(image), []
    for block in tower.encoder.layers:
        streams.append(stream)
        stream = block(stream, attention_mask=None)
    return torch.stack([*streams, stream])


def prompts(policy: Any, state: np.ndarray) -> list[str]:
    """The tasks as lerobot's processor words them."""
    if policy.config.type == "pi0":
        return [f"{task}\n" for task in TASKS]
    from lerobot.lerobot_types import TransitionKey
    from lerobot.policies.pi0_fast.processor_pi0_fast import Pi0FastPrepareStateAndLanguageTokenizerProcessorStep
    from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep

    steps = {
        "pi05": Pi05PrepareStateTokenizerProcessorStep,
        "pi0_fast": Pi0FastPrepareStateAndLanguageTokenizerProcessorStep,
    }
    worded = steps[policy.config.type]()(
        {
            TransitionKey.OBSERVATION: {"observation.state": torch.from_numpy(state)},
            TransitionKey.COMPLEMENTARY_DATA: {"task": list(TASKS)},
        }
    )
    return list(worded[TransitionKey.COMPLEMENTARY_DATA]["task"])


def quantiles(checkpoint: Path, pipeline: str, feature: str) -> tuple[np.ndarray, np.ndarray]:
    """q01 and q99 of a feature."""
    (file,) = checkpoint.glob(f"policy_{pipeline}_step_*.safetensors")
    values = load_file(file)
    return values[f"{feature}.q01"].numpy(), values[f"{feature}.q99"].numpy()


def main() -> None:
    """Write `reference.npz`, the checkpoint and a README of one paragraph."""
    parser = reference_parser(str(__doc__))
    parser.add_argument("--cameras", nargs="+", default=["base"])
    arguments = parser.parse_args()
    config: Any = PreTrainedConfig.from_pretrained(arguments.checkpoint)
    if config.type == "molmoact2":
        with torch.inference_mode():
            write(arguments, config.type, record_layers(arguments.checkpoint, config, arguments.seed))
        return
    policy, rng = lerobots_policy(arguments.checkpoint), np.random.default_rng(arguments.seed)
    low, high = quantiles(arguments.checkpoint, "preprocessor", "observation.state")
    raw = rng.uniform(low, high, (len(TASKS), len(low))).astype(np.float32)
    state = (2 * (raw - low) / (high - low) - 1).astype(np.float32)
    config, names = policy.config, [f"observation.images.{name}" for name in arguments.cameras]
    shapes = [config.input_features[name].shape for name in names]
    pictures = [rng.uniform(0, 1, (len(TASKS), *shape)).astype(np.float32) for shape in shapes]
    text = AutoTokenizer.from_pretrained(arguments.checkpoint)(
        prompts(policy, state), padding="max_length", max_length=config.tokenizer_max_length, return_tensors="pt"
    )
    mask = text["attention_mask"].bool()
    batch = {
        **{name: torch.from_numpy(picture) for name, picture in zip(names, pictures, strict=True)},
        "observation.state": torch.from_numpy(state),
        "observation.language.tokens": text["input_ids"],
        "observation.language.attention_mask": mask,
    }
    noise = torch.randn(
        (len(TASKS), config.chunk_size, config.max_action_dim),
        generator=torch.Generator().manual_seed(arguments.seed),
    )
    with torch.inference_mode():
        outputs = record_tokens(policy, batch) if config.type == "pi0_fast" else record(policy, batch, noise)
    least, most = quantiles(arguments.checkpoint, "postprocessor", "action")
    outputs["actions_unnormalized"] = (outputs["actions"] + 1) / 2 * (most - least) + least
    outputs |= {"in_raw_state": raw, "in_state": state, "in_lang_mask": mask.numpy()}
    if config.type != "pi0_fast":
        outputs["in_noise"] = noise.numpy()
    outputs["in_lang_tokens"] = text["input_ids"].numpy()
    outputs |= {f"in_image_{name}": picture for name, picture in zip(arguments.cameras, pictures, strict=True)}
    write(arguments, config.type, outputs)


def write(arguments: argparse.Namespace, kind: str, outputs: dict[str, np.ndarray]) -> None:
    """The reference beside a copy of the checkpoint, and where both come from."""
    recorded = (
        f"{kind}\n\nRecorded by `scripts/record_reference.py` with lerobot's own blocks, called one by one; "
        f"{WEIGHTS.get(kind, 'random weights')}"
    )
    write_reference(arguments.checkpoint, arguments.folder, outputs, recorded, (torch, transformers, lerobot))


if __name__ == "__main__":
    main()
