"""What listening costs: one inference plain, captured by probe_kit, and by the ways people do it otherwise.

    uv run --with nnsight python benchmarks/capture.py [--repeats 15] [--device cuda] [--size mid|pi0]

Same model, same batch, same process, interleaved; prints medians of wall and CPU time and their ratio to plain.
`mid`: lerobot's pi0 with 12 layers of width 512 and 256 image tokens. `pi0`: the released size, random weights.

* pooled: every residual site, four views per stream, reduced on the device as it fires.
* tokens: a copy of every token of every residual site.
* raw hooks: forward hooks on every layer, `.detach().cpu()` of each output.
* output_hidden_states: transformers' own switch on both stacks. Its last entry is normed, and what it returns is
  dropped by lerobot, so this is the cost of collecting alone.
* nnsight: the output of every layer at every iteration, saved in a trace (132 tensors; pooled reads 143).
"""

import argparse
import importlib.util
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from torch import Tensor, nn

from probe_kit.hooks.capture_context import capture
from probe_kit.hooks.families.lerobot_flow import IMAGES, MASK, STATE, TOKENS
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.hooks.roles import Roles, pool
from probe_kit.hooks.sites import Site
from probe_kit.hooks.views import view_names
from probe_kit.models.initialisation import initialise
from probe_kit.models.pi0 import GemmaSize, Pi0Size, SiglipSize, build_pi0

MID = Pi0Size(
    vlm=GemmaSize(512, 12, 2048, 8, 1, 64),
    expert=GemmaSize(256, 12, 1024, 8, 1, 64),
    vision=SiglipSize(128, 2, 4, 256, 14),
    vocab_size=1024,
)


class Benchmark:
    """One model, one batch, and every way to run it."""

    def __init__(self, size: Pi0Size | None, device: str) -> None:
        from pathlib import Path

        config = PI0Config(
            input_features={
                f"{IMAGES}base": PolicyFeature(FeatureType.VISUAL, (3, 224, 224)),
                STATE: PolicyFeature(FeatureType.STATE, (8,)),
            },
            output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
            device="cpu",
            dtype="float32" if device == "cpu" else "bfloat16",
        )
        network = build_pi0(config, size)
        initialise(network, seed=0)
        config.device = device
        self.policy = Pi0(network.to(device), Path())
        generator = torch.Generator().manual_seed(0)
        self.batch = {
            f"{IMAGES}base": torch.rand((1, 3, 224, 224), generator=generator).to(device),
            STATE: torch.zeros(1, 8, device=device),
            TOKENS: torch.randint(4, 1000, (1, 48), generator=generator).to(device),
            MASK: torch.ones(1, 48, dtype=torch.bool, device=device),
        }
        self.noise = self.policy.noise([0])
        self.roles = {
            "backbone": Roles.from_labels([*["image.base"] * 256, *["language"] * 48]),
            "expert": Roles.from_labels(["state", *["action"] * config.chunk_size]),
        }

    def plain(self) -> Tensor:
        """The inference alone."""
        return self.policy.infer(self.batch, self.noise)

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
        layers = [layer for stack in self.policy.stacks.values() for layer in stack.layers]
        handles = [
            layer.register_forward_hook(lambda _m, _i, output: kept.append(output.detach().cpu().clone()))
            for layer in layers
        ]
        try:
            return self.plain()
        finally:
            for handle in handles:
                handle.remove()

    def output_hidden_states(self) -> Tensor:
        """transformers collects; lerobot drops the result."""
        joint = self.policy.network.model.paligemma_with_expert
        with _switched(joint.paligemma.model.language_model.config), _switched(joint.gemma_expert.model.config):
            return self.plain()

    def nnsight(self) -> Tensor:
        """A trace that saves every layer's first output."""
        from nnsight import NNsight

        if not hasattr(self, "_traced"):
            self._traced = NNsight(_Callable(self.policy))
        with self._traced.trace(self.batch, self.noise) as tracer:
            joint = self._traced.network.model.paligemma_with_expert
            kept = [layer.output for layer in joint.paligemma.model.language_model.layers]
            for _ in tracer.iter[:10]:
                for layer in joint.gemma_expert.model.layers:
                    kept.append(layer.output)  # noqa: PERF401 - nnsight reads this source
            saved = kept.save()
            actions = self._traced.output.save()
        assert len(saved) == 12 + 10 * 12
        return actions

    def _reduce(self, site: Site, activation: Tensor) -> Tensor:
        roles = self.roles[site.stream]
        return pool(activation, roles, view_names(self.policy.role_names[site.stream]))


class _Callable(nn.Module):
    """nnsight traces `forward`; the policy acts through another method."""

    def __init__(self, policy: Pi0) -> None:
        super().__init__()
        self.network, self._policy = policy.network, [policy]

    def forward(self, batch: dict[str, Tensor], noise: Tensor) -> Tensor:
        return self._policy[0].infer(batch, noise)


@contextmanager
def _switched(config: Any) -> Iterator[None]:
    config.output_hidden_states = True
    try:
        yield
    finally:
        config.output_hidden_states = False


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
    parser.add_argument("--size", choices=["mid", "pi0"], default="mid")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    benchmark = Benchmark(MID if options.size == "mid" else None, options.device)
    names = ["plain", "pooled", "tokens", "raw_hooks", "output_hidden_states"]
    names += ["nnsight"] if importlib.util.find_spec("nnsight") else []
    reference = benchmark.plain()
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for name in names:
        assert torch.equal(getattr(benchmark, name)(), reference), f"{name} changed the actions"
    for _ in range(options.repeats):
        for name in names:
            times[name].append(measure(getattr(benchmark, name), options.device))
    base = [statistics.median(column) for column in zip(*times["plain"], strict=True)]
    print(f"{'variant':22}{'wall ms':>10}{'CPU ms':>10}{'wall x':>9}{'CPU x':>9}")
    for name in names:
        wall, cpu = (statistics.median(column) for column in zip(*times[name], strict=True))
        print(f"{name:22}{wall:10.1f}{cpu:10.1f}{wall / base[0]:9.3f}{cpu / base[1]:9.3f}")


if __name__ == "__main__":
    main()
