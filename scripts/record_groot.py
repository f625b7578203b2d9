"""Record a golden reference of GR00T N1.7: what lerobot's own loading, processors and modules put out.

    uv run python scripts/record_groot.py CHECKPOINT FOLDER

The checkpoint is a tiny one in lerobot's layout, with its base model in `base`, weights included, and the language
model's files in `base/vlm`, as `tests/hooks/families/groot/checkpoints.py` writes it. FOLDER gets no weights of
the base.
Nothing of probe_kit is used. The script fails unless the actions of the modules, called one after the other, equal
those of `predict_action_chunk`. `probe-kit verify groot FOLDER` compares the adapter with it.
"""

import os
from pathlib import Path
from typing import Any

import diffusers
import lerobot
import numpy as np
import torch
import transformers
from golden_folder import reference_parser, write_reference
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.groot import processor_groot
from lerobot.policies.groot.modeling_groot import GrootPolicy
from torch import Tensor

TASK = "Put the cube on the star."


def record(checkpoint: Path, seed: int) -> dict[str, np.ndarray]:
    """Every quantity of one inference; see `probe_kit.hooks.families.shared.lerobot.outputs`."""
    config: Any = PreTrainedConfig.from_pretrained(checkpoint)
    config.base_model_path = str(checkpoint / config.base_model_path)
    os.chdir(config.base_model_path)  # its configuration names the language model `vlm`
    build = processor_groot._build_n1_7_processor
    processor_groot._build_n1_7_processor = lambda _: build("vlm")
    policy = GrootPolicy.from_pretrained(str(checkpoint), config=config).eval()
    before, behind = processor_groot.make_groot_pre_post_processors_from_pretrained(config, str(checkpoint))
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 256, (48, 80, 3), np.uint8)
    state = rng.uniform(-0.2, 0.8, config.input_features["observation.state"].shape).astype(np.float32)
    batch = before(
        {
            "observation.images.image": torch.from_numpy(picture).permute(2, 0, 1),
            "observation.state": torch.from_numpy(state),
            "task": TASK,
        }
    )
    outputs: dict[str, Any] = {name: batch[name] for name in ("input_ids", "pixel_values", "state")}
    inner, head = policy._groot_model, policy._groot_model.action_head
    inputs, model_inputs = inner.prepare_input(policy._filter_groot_inputs(batch, include_action=False))
    prompt = inner.backbone(inputs)
    outputs["backbone_end"] = prompt.backbone_features
    outputs["backbone_final_norm"] = head.vlln(prompt.backbone_features)
    read, bridge = head.vl_self_attention(outputs["backbone_final_norm"], return_all_hidden_states=True)
    outputs["bridge_resid"] = torch.stack(bridge)
    torch.manual_seed(seed)
    moved = torch.randn(1, head.action_horizon, head.action_dim)
    outputs["in_noise"] = moved
    features = head.state_encoder(model_inputs.state, model_inputs.embodiment_id)
    columns: dict[str, list[Tensor]] = {"expert_resid": [], "velocity": []}
    for step in range(head.num_inference_timesteps):
        time = torch.tensor([int(step / head.num_inference_timesteps * head.num_timestep_buckets)])
        noisy = head.action_encoder(moved, time, model_inputs.embodiment_id)
        noisy = noisy + head.position_embedding(torch.arange(noisy.shape[1]))
        out, hidden = head.model(
            torch.cat([features, noisy], 1), read, time, return_all_hidden_states=True,
            image_mask=prompt.image_mask, backbone_attention_mask=prompt.backbone_attention_mask,
        )  # fmt: skip
        velocity = head.action_decoder(out, model_inputs.embodiment_id)[:, -head.action_horizon :]
        moved = moved + velocity / head.num_inference_timesteps
        columns["expert_resid"].append(torch.stack(hidden))
        columns["velocity"].append(velocity)
    outputs |= {name: torch.stack(values) for name, values in columns.items()}
    torch.manual_seed(seed)
    outputs["actions"] = policy.predict_action_chunk(batch)
    length, numbers = outputs["actions"].shape[1:]
    apart = float((outputs["actions"] - moved[:, :length, :numbers]).abs().max())
    if apart > 1e-6:
        raise SystemExit(f"lerobot's modules, called one by one, give actions that are off by {apart:.3g}")
    outputs["actions_unnormalized"] = behind(outputs["actions"])
    arrays = {name: value.detach().numpy() for name, value in outputs.items()}
    return arrays | {"in_raw_state": state, "in_image": picture, "in_task": np.array(TASK)}


def main() -> None:
    """Write the reference beside a copy of the checkpoint, without the base model's weights."""
    arguments = reference_parser(str(__doc__).splitlines()[0]).parse_args()
    checkpoint, folder = arguments.checkpoint.resolve(), arguments.folder.resolve()
    with torch.inference_mode():
        outputs = record(checkpoint, arguments.seed)
    recorded = (
        "groot\n\nRecorded by `scripts/record_groot.py` with lerobot's own loading, processors and modules; "
        "random weights"
    )
    write_reference(checkpoint, folder, outputs, recorded, (torch, transformers, diffusers, lerobot))
    for weights in (folder / "checkpoint" / "base").glob("*.safetensors*"):
        weights.unlink()


if __name__ == "__main__":
    main()
