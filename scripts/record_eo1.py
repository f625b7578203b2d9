"""Record a golden reference of EO-1: what lerobot's own loading, processors and sampling put out.

    uv run python scripts/record_eo1.py CHECKPOINT FOLDER

The checkpoint is a tiny one in lerobot's layout, whose processor's files lie in its folder `vlm`. Nothing of
probe_kit is used: torch's own hooks read the modules of one `predict_action_chunk`. `probe-kit verify eo1 FOLDER`
compares the adapter with it.
"""

from pathlib import Path
from typing import Any

import lerobot
import numpy as np
import torch
import transformers
from golden_folder import reference_parser, write_reference
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.eo1.modeling_eo1 import EO1Policy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action

TASK = "Put the cube on the star"


def record(checkpoint: Path, seed: int) -> dict[str, np.ndarray]:
    """Every quantity of one inference."""
    config: Any = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint  # else lerobot downloads Qwen2.5-VL
    policy: Any = EO1Policy.from_pretrained(str(checkpoint), config=config).eval()
    vlm = {"eo1_qwen_processor": {"processor_name": str(checkpoint / "vlm")}}
    before = PolicyProcessorPipeline.from_pretrained(checkpoint, "policy_preprocessor.json", overrides=vlm)
    behind: Any = PolicyProcessorPipeline.from_pretrained(
        checkpoint, "policy_postprocessor.json", to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 256, (48, 80, 3), np.uint8)
    state = rng.uniform(-0.2, 0.8, policy.config.input_features["observation.state"].shape).astype(np.float32)
    batch = before(
        {
            "observation.images.image": torch.from_numpy(picture).permute(2, 0, 1).float() / 255,
            "observation.state": torch.from_numpy(state),
            "task": TASK,
        }
    )
    decoder = policy.model.vlm_backbone.model.language_model
    entered: list[list[torch.Tensor]] = [[] for _ in range(len(decoder.layers) + 1)]
    normed, velocity, caches = [], [], []
    for number, module in enumerate([*(layer.input_layernorm for layer in decoder.layers), decoder.norm]):
        module.register_forward_pre_hook(
            lambda _, arguments, collected=entered[number]: collected.append(arguments[0].clone())
        )
    decoder.norm.register_forward_hook(lambda _, __, output: normed.append(output.clone()))
    policy.model.action_out_proj.register_forward_hook(lambda _, __, output: velocity.append(output.clone()))
    policy.model.vlm_backbone.model.register_forward_hook(
        lambda _, __, output: caches.append(
            [(layer.keys.clone(), layer.values.clone()) for layer in output.past_key_values.layers]
        )
    )
    torch.manual_seed(seed)
    noise = policy.model.sample_noise((1, policy.config.chunk_size, policy.config.max_action_dim), "cpu")
    torch.manual_seed(seed)
    actions = policy.predict_action_chunk(batch)
    keys, values = (torch.stack([row[part].transpose(1, 2).flatten(2) for row in caches[0]]) for part in (0, 1))
    steps = range(1, policy.config.num_denoise_steps + 1)
    outputs = {
        **{name: batch[name] for name in ("input_ids", "attention_mask", "pixel_values", "image_grid_thw")},
        "backbone_resid": torch.stack([entering[0] for entering in entered]),
        "backbone_final_norm": normed[0],
        "keys": keys,
        "values": values,
        "expert_resid": torch.stack([torch.stack([entering[step] for entering in entered]) for step in steps]),
        "expert_final_norm": torch.stack([normed[step] for step in steps]),
        "velocity": torch.stack(velocity),
        "in_noise": noise,
        "actions": actions,
        "actions_unnormalized": behind(actions),
    }
    arrays = {name: value.detach().numpy() for name, value in outputs.items()}
    return arrays | {"in_raw_state": state, "in_image": picture, "in_task": np.array(TASK)}


def main() -> None:
    """Write the reference beside a copy of the checkpoint."""
    arguments = reference_parser(str(__doc__).splitlines()[0]).parse_args()
    outputs = record(arguments.checkpoint, arguments.seed)
    recorded = (
        "eo1\n\nRecorded by `scripts/record_eo1.py` with lerobot's own loading, processors and sampling; "
        "random weights"
    )
    write_reference(arguments.checkpoint, arguments.folder, outputs, recorded, (torch, transformers, lerobot))


if __name__ == "__main__":
    main()
