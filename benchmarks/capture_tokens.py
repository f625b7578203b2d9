"""What listening costs where actions are tokens: one inference of SpatialVLA plain, and captured.

    uv run python benchmarks/capture_tokens.py [--repeats 15] [--device cuda] [--threads 1]

Random weights, the released proportions: 12 layers of Gemma-2 of width 512 (64 patches, twelve tokens decoded),
SigLIP and ZoeDepth smaller. Same model, same batch, same process, interleaved; medians and their ratio to plain.

* pooled: every residual site of the prompt and of three action tokens, all views, reduced as it fires.
* tokens: a copy of every token of the same sites.
* raw hooks: forward hooks on every layer, `.detach().cpu()` of each output at each of the twelve calls.
* output_hidden_states: transformers' own switch, which returns every layer at each of the twelve calls.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from probe_kit.hooks.capture_context import capture
from probe_kit.hooks.families.spatialvla.adapter import SpatialVLA, choose_statistics
from probe_kit.hooks.families.spatialvla.checkpoint import LoadedSpatialVLA
from probe_kit.hooks.families.spatialvla.speech import Speech
from probe_kit.hooks.roles import Roles, pool
from probe_kit.hooks.sites import Site
from probe_kit.hooks.views import view_names
from probe_kit.hooks.weights import Weights, load_weights
from probe_kit.models.initialisation import initialise
from probe_kit.models.spatialvla import SpatialVLAConfig, build_spatialvla

ACTIONS, WORDS, SIDE = 8194, 4000, 112
_DEPTH = {
    "backbone_config": {
        "model_type": "beit", "hidden_size": 64, "image_size": 384, "intermediate_size": 128,
        "num_attention_heads": 4, "num_hidden_layers": 4, "out_features": ["stage1", "stage2", "stage3", "stage4"],
        "reshape_hidden_states": False, "use_relative_position_bias": True,
    },
    "bin_configurations": [
        {"name": name, "n_bins": 16, "min_depth": 0.001, "max_depth": most}
        for name, most in (("nyu", 10.0), ("kitti", 80.0))
    ],
    "bin_embedding_dim": 16, "bottleneck_features": 16, "fusion_hidden_size": 16,
    "neck_hidden_sizes": [16, 16, 32, 32],
    "num_patch_transformer_layers": 4, "num_relative_features": 8, "patch_transformer_hidden_size": 128,
    "patch_transformer_intermediate_size": 128, "patch_transformer_num_attention_heads": 4,
}  # fmt: skip
VALUES: dict[str, Any] = {
    "model_type": "spatialvla", "image_token_index": WORDS, "action_token_begin_idx": WORDS + 1,
    "spatial_token_num": ACTIONS, "use_spatial_token": True, "ego3d_patch_reso": 2, "n_freqs": 8,
    "projection_dim": 512, "vision_zoe_config": _DEPTH,
    "text_config": {
        "hidden_size": 512, "intermediate_size": 2048, "num_hidden_layers": 12, "num_attention_heads": 8,
        "num_key_value_heads": 4, "head_dim": 64, "query_pre_attn_scalar": 64, "tie_word_embeddings": False,
        "vocab_size": WORDS + 1 + ACTIONS,
    },
    "vision_config": {
        "hidden_size": 256, "intermediate_size": 512, "num_hidden_layers": 4, "num_attention_heads": 4,
        "image_size": SIDE, "patch_size": 14, "vision_use_head": False,
    },
}  # fmt: skip
PROCESSOR: dict[str, Any] = {
    "action_chunk_size": 4,
    "action_config": {
        "distribution": "uniform",
        "num_bins": {
            "translation": {"theta_bins": 16, "phi_bins": 32, "r_bins": 8},
            "rotation": {"roll_bins": 16, "pitch_bins": 16, "yaw_bins": 16},
            "gripper": 2,
        },
    },
    "statistics": {"bridge_orig/1.0.0": {"action": {"q01": [-1.0] * 7, "q99": [1.0] * 7}}},
}


class Benchmark:
    """One model, one batch, and every way to run it."""

    def __init__(self, device: str, folder: Path) -> None:
        dtype = torch.float32 if device == "cpu" else torch.bfloat16
        network = build_spatialvla(SpatialVLAConfig.from_json(VALUES), dtype, device="cpu")
        initialise(network, seed=0)
        weights = Weights(network.state_dict(), "benchmark", random=True)
        audit = load_weights(network, weights, weights.tensors)
        network.requires_grad_(False)
        network.embed_actions()
        loaded = LoadedSpatialVLA(
            "benchmark", network.to(device), folder, PROCESSOR, audit, str(dtype), device, weights_seed=0
        )
        speech = Speech.of(loaded.config, folder, None, lowercase=True, tokenizer="bytes")
        statistics_used = choose_statistics(loaded, None)
        self.policy = SpatialVLA(loaded, speech, statistics_used, "scene", 12, 3, constrained=False)
        generator = torch.Generator().manual_seed(0)
        self.pictures = torch.rand((1, 3, SIDE, SIDE), generator=generator).to(device)
        self.cameras = torch.tensor([[[100.0, 0, 56], [0, 100, 56], [0, 0, 1]]], device=device)
        self.prompt = self.policy.prompt("put the cube on the red shape")
        labels = ["image.primary"] * network.config.patches + ["special"]
        labels += ["language"] * (len(self.prompt) - 1 - len(labels))
        self.roles = {"backbone": Roles.from_labels(labels), "action": Roles.from_labels(["action"])}

    def plain(self) -> Tensor:
        """The inference alone."""
        return self.policy.generate(self.pictures, self.cameras, [self.prompt]).ids

    def pooled(self) -> Tensor:
        """Every site reduced to its views on the device."""
        with capture(self.policy, self.policy.sites(), reduce=self._reduce):
            return self.plain()

    def tokens(self) -> Tensor:
        """Every token of every site."""
        with capture(self.policy, self.policy.sites()):
            return self.plain()

    def raw_hooks(self) -> Tensor:
        """What one writes in five minutes."""
        kept: list[Tensor] = []
        handles = [
            layer.register_forward_hook(lambda _m, _i, output: kept.append(output.detach().cpu().clone()))
            for layer in self.policy.decoder.layers
        ]
        try:
            return self.plain()
        finally:
            for handle in handles:
                handle.remove()

    def output_hidden_states(self) -> Tensor:
        """transformers collects at every call of the language model."""
        kept: list[Any] = []
        language_model = self.policy.network.language_model
        before = language_model.forward
        language_model.forward = lambda **given: _collect(before, kept, given)
        try:
            return self.plain()
        finally:
            language_model.forward = before

    def _reduce(self, site: Site, activation: Tensor) -> Tensor:
        return pool(activation, self.roles[site.stream], view_names(self.policy.role_names[site.stream]))


def _collect(forward: Callable[..., Any], kept: list[Any], given: dict[str, Any]) -> Any:
    output = forward(**{**given, "output_hidden_states": True})
    kept.append(output.hidden_states)
    return output


def measure(run: Callable[[], Tensor], device: str) -> tuple[float, float]:
    """Wall and CPU milliseconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    run()
    if device != "cpu":
        torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)


def main() -> None:
    """Interleave all variants, so that a busy moment hits them alike."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    with tempfile.TemporaryDirectory() as folder:
        benchmark = Benchmark(options.device, Path(folder))
        names = ["plain", "pooled", "tokens", "raw_hooks", "output_hidden_states"]
        reference = benchmark.plain()
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
        for name in names:
            assert torch.equal(getattr(benchmark, name)(), reference), f"{name} changed the tokens"
        for _ in range(options.repeats):
            for name in names:
                times[name].append(measure(getattr(benchmark, name), options.device))
    print(f"{benchmark.policy.card.parameters / 1e6:.0f} million parameters")
    base = [statistics.median(column) for column in zip(*times["plain"], strict=True)]
    print(f"{'variant':22}{'wall ms':>10}{'CPU ms':>10}{'wall x':>9}{'CPU x':>9}")
    for name in names:
        wall, cpu = (statistics.median(column) for column in zip(*times[name], strict=True))
        print(f"{name:22}{wall:10.1f}{cpu:10.1f}{wall / base[0]:9.3f}{cpu / base[1]:9.3f}")


if __name__ == "__main__":
    main()
