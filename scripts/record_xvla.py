"""Record a golden reference of X-VLA: what lerobot's own loading, processors and modules put out.

    uv run python scripts/record_xvla.py CHECKPOINT FOLDER

The checkpoint is a tiny one in lerobot's layout, with its tokenizer beside it. Nothing of probe_kit is used. The
script fails unless the actions of the modules, called one after the other, equal those of `predict_action_chunk`.
`probe-kit verify xvla FOLDER` compares the adapter with it.
"""

from pathlib import Path
from typing import Any

import lerobot
import numpy as np
import torch
import transformers
from golden_folder import reference_parser, write_reference
from lerobot.policies.xvla.modeling_xvla import XVLAPolicy
from lerobot.policies.xvla.soft_transformer import timestep_embedding
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
from torch import Tensor

TASK = "Put the cube on the star"


def record(checkpoint: Path, seed: int) -> dict[str, np.ndarray]:
    """Every quantity of one inference; see `probe_kit.hooks.families.shared.lerobot.outputs`."""
    policy: Any = XVLAPolicy.from_pretrained(str(checkpoint))
    before = PolicyProcessorPipeline.from_pretrained(
        checkpoint,
        "policy_preprocessor.json",
        overrides={"tokenizer_processor": {"tokenizer_name": str(checkpoint)}},
    )
    behind: Any = PolicyProcessorPipeline.from_pretrained(
        checkpoint,
        "policy_postprocessor.json",
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 256, (48, 80, 3), np.uint8)
    state = rng.uniform(-0.2, 0.8, policy.config.input_features["observation.state"].shape).astype(np.float32)
    batch = before(
        {
            "observation.images.image": torch.from_numpy(picture).permute(2, 0, 1),
            "observation.state": torch.from_numpy(state),
            "task": TASK,
        }
    )
    model_inputs, model = policy._build_model_inputs(batch), policy.model
    outputs: dict[str, Any] = {"input_ids": model_inputs["input_ids"], "pixels": model_inputs["image_input"]}
    encoder = model.vlm.language_model.encoder
    with torch.no_grad():
        prompt = model.forward_vlm(
            model_inputs["input_ids"], model_inputs["image_input"], model_inputs["image_mask"]
        )
        outputs["backbone_resid"] = backbone_streams(model, model_inputs)
    apart = float((outputs["backbone_resid"][-1] - prompt["vlm_features"]).abs().max())
    if apart > 1e-5 or len(outputs["backbone_resid"]) != len(encoder.layers) + 1:
        raise SystemExit(f"Florence-2's layers, called one by one, are off by {apart:.3g}")
    torch.manual_seed(seed)
    noise = torch.randn(1, policy.config.chunk_size, model.dim_action)
    steps, actions = policy.config.num_denoising_steps, torch.zeros_like(noise)
    columns: dict[str, list[Tensor]] = {"expert_resid": [], "predicted": []}
    for steps_left in range(steps, 0, -1):
        time = torch.tensor([steps_left / steps])
        proprioception, noisy = model.action_space.preprocess(
            model_inputs["proprio"], noise * time + actions * (1 - time)
        )
        streams, actions = expert_streams(
            model.transformer, prompt, model_inputs["domain_id"], noisy, proprioception, time
        )
        columns["expert_resid"].append(streams)
        columns["predicted"].append(actions)
    outputs |= {name: torch.stack(values) for name, values in columns.items()} | {"in_noise": noise}
    torch.manual_seed(seed)
    outputs["actions"] = policy.predict_action_chunk(batch)
    apart = float((outputs["actions"] - model.action_space.postprocess(actions)).abs().max())
    if apart > 1e-5:
        raise SystemExit(f"lerobot's modules, called one by one, give actions that are off by {apart:.3g}")
    outputs["actions_unnormalized"] = behind(outputs["actions"])
    arrays = {name: value.detach().numpy() for name, value in outputs.items()}
    return arrays | {"in_raw_state": state, "in_image": picture, "in_task": np.array(TASK)}


def backbone_streams(model: Any, model_inputs: dict[str, Tensor]) -> Tensor:
    """(L + 1, 1, T, D) of Florence-2's encoder, whose layers are called one after the other."""
    encoder, views = model.vlm.language_model.encoder, model_inputs["image_input"]
    picture = model.vlm.get_image_features(views[:, 0]).pooler_output
    stream = torch.cat([picture, model.vlm.get_input_embeddings()(model_inputs["input_ids"])], dim=1)
    stream = encoder.layernorm_embedding(stream + encoder.embed_positions(stream[..., -1]))
    streams = [stream]
    for layer in encoder.layers:
        stream = layer(stream, None)
        streams.append(stream)
    return torch.stack(streams)


def expert_streams(
    expert: Any, prompt: dict[str, Tensor], domain: Tensor, noisy: Tensor, state: Tensor, time: Tensor
) -> tuple[Tensor, Tensor]:
    """(L + 1, 1, T, D) of the expert, whose blocks are called one after the other, and what it predicts."""
    length = noisy.shape[1]
    times = timestep_embedding(time, expert.dim_time)
    tokens = [vector[:, None].expand(-1, length, -1) for vector in (state, times)]
    stream = torch.cat(
        [
            expert.action_encoder(torch.cat([noisy, *tokens], dim=-1), domain),
            expert.vlm_proj(prompt["vlm_features"]),
            expert.aux_visual_proj(prompt["aux_visual_inputs"]),
        ],
        dim=1,
    )
    stream = stream + expert.pos_emb[:, : stream.shape[1]]
    soft_prompt = expert.soft_prompt_hub(domain).view(1, expert.len_soft_prompts, expert.hidden_size)
    stream = torch.cat([stream, soft_prompt], dim=1)
    streams = [stream]
    for block in expert.blocks:
        stream = block(stream)
        streams.append(stream)
    return torch.stack(streams), expert.action_decoder(expert.norm(stream[:, :length]), domain)


def main() -> None:
    """Write the reference beside a copy of the checkpoint."""
    arguments = reference_parser(str(__doc__).splitlines()[0]).parse_args()
    with torch.inference_mode():
        outputs = record(arguments.checkpoint, arguments.seed)
    recorded = (
        "xvla\n\nRecorded by `scripts/record_xvla.py` with lerobot's own loading, processors and modules; "
        "random weights"
    )
    write_reference(arguments.checkpoint, arguments.folder, outputs, recorded, (torch, transformers, lerobot))


if __name__ == "__main__":
    main()
