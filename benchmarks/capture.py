"""Cost of capture in every family: one clean inference, one captured by probe_kit, and one by each rival.

    python benchmarks/capture.py [--families pi0,openvla] [--repeats 7] [--host] [--keep DIR]
    python benchmarks/capture.py --families pi0 --checkpoint DIR --device cuda [--dtype bfloat16] [--batch 8]
        [--trace FILE]
    python benchmarks/capture.py --full --device cuda
    python benchmarks/capture.py --count [--families pi0,openvla]

Each family at 110 to 160 million random parameters, with `--full` three at the released size, or one at the size
of a checkpoint, whose weights need not be there: the same model, observation and process for all ways, in turns. A
ratio is that of one turn to the plain inference of the same turn; medians are printed, of processor time on a CPU
(whatever else the machine does) and of wall time on a GPU. No way may change the numbers that come out, which is
checked bit for bit first.

* pooled: every residual site, all views, reduced on the device as it fires.
* tokens: a copy of every token of every residual site.
* pooled to host, tokens to host (`--host`): as a run stores them, with bits and copies into an episode's buffers;
  on a GPU the next inference begins before they have arrived.
* output_hidden_states: transformers' own switch on the same stacks, where the family's network heeds it. It keeps
  references, copies nothing, and its last entry is normed.
* raw hooks: forward hooks on every layer, `.detach().cpu().clone()` of each output.

`--count` counts operations instead, which any machine can: those that torch dispatches in one inference, plain and
captured, of the acting families at the depths and steps that were released, with tiny widths. The first capture of
a process is not counted; it also finds out what the network writes in place.

`--trace` saves a profiler trace of one inference with `tokens to host` and counts what waited for the device.
`--keep` keeps a family's line in DIR, so that the same command resumes.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from capture_subjects import DEEP, FULL, LARGER, Subject, hidden_states, subject
from numpy.typing import NDArray
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from probe_kit.extract.rollout.capturing import Capturer, EpisodeBuffers, stored_streams
from probe_kit.hooks import capture
from probe_kit.hooks.capturing.capture_context import capture_views
from probe_kit.hooks.contract.roles import pool_weights

WAITS = ("cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize", "aten::item")
COUNTED = ("plain", "pooled", "tokens", "pooled to host", "tokens to host")
Output = NDArray[np.float32]


class Benchmark:
    """Every way to run one inference."""

    def __init__(self, subject: Subject, device: str) -> None:
        self.subject, self.model, self.plain = subject, subject.model, subject.infer
        self.streams = stored_streams(self.model, subject.roles)
        self.rows = len(next(iter(subject.roles.values())))
        self._pinned = device.startswith("cuda")
        self._hosts: dict[bool, tuple[Capturer, list[dict[int, EpisodeBuffers]]]] = {}

    def ways(self, host: bool) -> dict[str, Callable[[], Output]]:
        """By name, as far as the family has them; the clean one first."""
        by_way: dict[str, Callable[[], Output]] = {
            "plain": self.plain, "pooled": self.pooled, "tokens": self.tokens,
        }  # fmt: skip
        if host:
            by_way |= {"pooled to host": self.pooled_to_host, "tokens to host": self.tokens_to_host}
        with hidden_states(self.subject) as counts:
            self.plain()
        if counts and min(counts) > 0:
            by_way["output_hidden_states"] = self.output_hidden_states
        return by_way | ({"raw hooks": self.raw_hooks} if self.subject.layers else {})

    def pooled(self) -> Output:
        """Every site reduced to its views on the device."""
        views = {stored.name: stored.views for stored in self.streams}
        weights = {
            name: pool_weights(roles, views[name], self.model.card.device)
            for name, roles in self.subject.roles.items()
            if name in views
        }
        with capture_views(self.model, self.model.sites(), weights):
            return self.plain()

    def tokens(self) -> Output:
        """Every token of every site."""
        with capture(self.model, self.model.sites()):
            return self.plain()

    def pooled_to_host(self) -> Output:
        """As a run stores views."""
        return self._to_host(with_tokens=False)

    def tokens_to_host(self) -> Output:
        """As a run stores tokens."""
        return self._to_host(with_tokens=True)

    def output_hidden_states(self) -> Output:
        """Let transformers collect."""
        with hidden_states(self.subject):
            return self.plain()

    def raw_hooks(self) -> Output:
        """What one writes in five minutes."""
        copies: list[Tensor] = []
        handles = [
            layer.register_forward_hook(
                lambda _m, _i, output: copies.append(_first(output).detach().cpu().clone())
            )
            for layer in self.subject.layers
        ]
        try:
            return self.plain()
        finally:
            for handle in handles:
                handle.remove()

    def _to_host(self, with_tokens: bool) -> Output:
        if with_tokens not in self._hosts:
            sets = [
                {row: EpisodeBuffers(self.streams, 1, with_tokens, self._pinned) for row in range(self.rows)}
                for _ in range(2)
            ]
            self._hosts[with_tokens] = Capturer(self.model, self.streams, with_tokens, "numbers"), sets
        capturer, sets = self._hosts[with_tokens]
        sets.reverse()
        for transfer in sets[0].values():
            transfer.wait()  # from the inference before last
            transfer.roles = []
        return capturer.run(self.plain, lambda numbers: numbers, self.subject.roles, sets[0])


class OperationCount(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """A mode that counts what torch dispatches."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.count: int = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        del types
        self.count += 1
        return func(*args, **(kwargs or {}))


def count_operations(run: Callable[[], Output]) -> int:
    """The operations of one call."""
    with OperationCount() as operations:
        run()
    return int(operations.count)


def counted(family: str, options: argparse.Namespace, folder: Path) -> str:
    """The operations of one family at released depth, as a row."""
    dtype = options.dtype or "float32"
    loaded = subject(family, folder, options.device, dtype, options.batch, sizes=DEEP)
    benchmark = Benchmark(loaded, options.device)
    ways = {name: way for name, way in benchmark.ways(host=True).items() if name in COUNTED}
    for way in ways.values():
        way()
    counts = {name: count_operations(way) for name, way in ways.items()}
    captured = "  ".join(
        f"{name} +{count - counts['plain']} ({count / counts['plain']:.4f})"
        for name, count in counts.items()
        if name != "plain"
    )
    return f"{family}: plain {counts['plain']} operations, {len(loaded.model.sites())} sites: {captured}"


def _first(output: Tensor | tuple[Tensor, ...]) -> Tensor:
    return output[0] if isinstance(output, tuple) else output


def _default_dtype(family: str, device: str) -> str:
    """`bfloat16` on a GPU, save in families that refuse it."""
    return "float32" if device == "cpu" or family == "smolvla" else "bfloat16"


def measure(run: Callable[[], Output], device: str) -> float:
    """Seconds of one call: of the processor, or by the clock where a GPU works."""
    on_cpu = device == "cpu"
    clock = time.process_time if on_cpu else time.perf_counter
    start = clock()
    run()
    if not on_cpu:
        torch.cuda.synchronize()
    return clock() - start


def line(family: str, options: argparse.Namespace, folder: Path) -> str:
    """The cost of capturing one family, as a row."""
    dtype, sizes = options.dtype or _default_dtype(family, options.device), FULL if options.full else LARGER
    loaded = subject(family, folder, options.device, dtype, options.batch, options.checkpoint, sizes)
    torch.set_num_threads(options.threads)
    benchmark = Benchmark(loaded, options.device)
    ways, reference = benchmark.ways(options.host), benchmark.plain()
    for name, way in ways.items():
        assert np.array_equal(way(), reference), f"{family}: {name} changed what comes out"
    ratios: dict[str, list[float]] = {name: [] for name in ways}
    plain = []
    for turn in range(options.repeats):
        order = list(ways)[turn % len(ways) :] + list(ways)[: turn % len(ways)]
        times = {name: measure(ways[name], options.device) for name in order}
        plain.append(times["plain"])
        for name, seconds in times.items():
            ratios[name].append(seconds / times["plain"])
    if options.trace:
        path = Path(options.trace)
        trace(benchmark.tokens_to_host, str(path.with_stem(f"{path.stem}-{family}")))
    card, sites = loaded.model.card, len(loaded.model.sites())
    tokens = ", ".join(f"{len(rows[0])} {name}" for name, rows in loaded.roles.items())
    summary = "  ".join(
        f"{name} {statistics.median(of):.3f} ({min(of):.2f}–{max(of):.2f})"
        for name, of in ratios.items()
        if name != "plain"
    )
    return (
        f"{family}: {card.parameters / 1e6:.0f} M {card.dtype} on {card.device}, {sites} sites, tokens {tokens}, "
        f"plain {1e3 * statistics.median(plain):.0f} ms × {options.repeats}: {summary}"
    )


def trace(run: Callable[[], Output], path: str) -> None:
    """Save a profiler trace and print what waited for the device in it."""
    with torch.profiler.profile(record_shapes=False) as profile:
        run()
    profile.export_chrome_trace(path)
    counts = {event.key: event.count for event in profile.key_averages() if event.key in WAITS}
    print(f"trace: {path}; waiting in one inference with capture: {counts or 'nothing'}")


def main() -> None:
    """One family after another."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", help="default: all")
    parser.add_argument("--full", action="store_true", help="at the released size")
    parser.add_argument("--checkpoint", help="its config gives the size; for one family")
    parser.add_argument("--dtype", help="default float32 on a CPU, else bfloat16 in families that have it")
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--host", action="store_true", help="also as a run stores them")
    parser.add_argument("--count", action="store_true", help="count operations at released depth")
    parser.add_argument("--trace")
    parser.add_argument("--keep", type=Path, help="a folder for the lines of finished families")
    options = parser.parse_args()
    make, sizes = (counted, DEEP) if options.count else (line, FULL if options.full else LARGER)
    for family in options.families.split(",") if options.families else sizes:
        result_file = options.keep / f"{family}.txt" if options.keep else None
        if result_file is None or not result_file.exists():
            with tempfile.TemporaryDirectory() as folder:
                result_line = make(family, options, Path(folder))
            if result_file is not None:
                result_file.parent.mkdir(parents=True, exist_ok=True)
                result_file.write_text(result_line, encoding="utf-8")
        print(result_file.read_text(encoding="utf-8") if result_file else result_line, flush=True)


if __name__ == "__main__":
    main()
