"""How much of its time a model waits for simulators, in the real loop with `--batch auto`.

    python benchmarks/waiting.py [--subjects tiny,large,full] [--items 12] [--max-steps 20] [--device cuda]
        [--spread]

`tiny` is the embedded pi0-tiny, whose inference is over in milliseconds: the worst case. `large` is a pi0 of 142
million random parameters, `full` one of the released size in bfloat16 (see `capture_subjects.py`). Batch and
simulating processes are what calibration chooses.
Time is the clock's, from the end of the first inference to the end of the last, without those seconds at the start
in which the first pictures are drawn; the model works while it is asked for actions (its capture included), and
waits the rest, for observations, buffers and this process's own affairs. Also printed: the
prediction of calibration, and the wall time without simulators. The share of each stage follows: the model, the
wait for scenes that begin, the wait for actions that are executed, and all else, such as buffers and commits.
Without simulators this process does that work itself.

Wall time means little on a busy machine: the share of its core that the model's process
got is printed too. `--spread` gives the model's process the first core and its simulators the others.
"""

import argparse
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import psutil
from capture_subjects import FULL, LARGER, written

from probe_kit.env import SceneSpec
from probe_kit.extract import Extraction, ExtractSettings, prepare
from probe_kit.extract.sources.player import Ending, LocalPlayer, ProcessPlayer
from probe_kit.suite import build_suite


@dataclass
class Clock:
    """Notes when the model works. spread: see `--spread`."""

    spread: bool
    calls: list[tuple[float, float, float]] = field(default_factory=list)
    """Begin and end of every call of the model, and the processor time of this process at its end."""
    answers: list[tuple[str, float, float]] = field(default_factory=list)
    """Begin and end of every wait for a player, and what it was asked for."""

    def around(self, infer: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """`infer`, timed."""

        def timed(turns: Sequence[Any]) -> Any:
            if self.spread and not self.calls:
                _spread()
            began = time.perf_counter()
            try:
                return infer(turns)
            finally:
                self.calls.append((began, time.perf_counter(), time.process_time()))

        return timed

    @contextmanager
    def around_players(self) -> Iterator[None]:
        """Time the answers of all players."""
        requests: dict[int, list[str]] = defaultdict(list)

        def asking(ask: Callable[..., None]) -> Callable[..., None]:
            def noted(player: Any, method: str, *arguments: Any, then: Any = None) -> None:
                requests[id(player)] = [method] if then is None else [method, then[0]]
                ask(player, method, *arguments, then=then)

            return noted

        def answering(answer: Callable[[Any], Any]) -> Callable[[Any], Any]:
            def timed(player: Any) -> Any:
                began = time.perf_counter()
                answered = answer(player)
                methods = requests[id(player)]
                self.answers.append((methods[0], began, time.perf_counter()))
                if isinstance(answered, Ending) and len(methods) > 1:
                    del methods[0]
                return answered

            return timed

        with (
            patch.multiple(LocalPlayer, ask=asking(LocalPlayer.ask), answer=answering(LocalPlayer.answer)),
            patch.multiple(ProcessPlayer, ask=asking(ProcessPlayer.ask), answer=answering(ProcessPlayer.answer)),
        ):
            yield

    @property
    def stages(self) -> str:
        """The share of every stage in the time after the first call."""
        (_, start, _), (_, end, _) = self.calls[0], self.calls[-1]
        seconds = {"model": sum(ended - began for began, ended, _ in self.calls[1:])}
        for name, method in (("scenes begin", "begin"), ("actions are executed", "advance")):
            waits = [(max(began, start), min(ended, end)) for of, began, ended in self.answers if of == method]
            seconds[name] = sum(max(0.0, ended - began) for began, ended in waits)
        seconds["all else"] = end - start - sum(seconds.values())
        return ", ".join(f"{name} {share / (end - start):.1%}" for name, share in seconds.items())

    @property
    def words(self) -> str:
        """Share of the time after the first call in which the model waited, and what a call took."""
        (_, start, processor), (_, end, processor_end) = self.calls[0], self.calls[-1]
        works = sum(ended - began for began, ended, _ in self.calls[1:])
        count = len(self.calls) - 1
        return (
            f"waited {1 - works / (end - start):6.1%} of {end - start:5.1f} s, {count} calls of "
            f"{1e3 * works / count:6.1f} ms; its process had "
            f"{(processor_end - processor) / (end - start):.2f} cores\n    stages: {self.stages}"
        )


def _spread() -> None:
    """This process to the first core it may use, its children and theirs to the others."""
    first, *other_cores = sorted(os.sched_getaffinity(0))
    if not other_cores:
        return
    this_process = psutil.Process()
    for child in this_process.children(recursive=True):
        child.cpu_affinity(other_cores)
    for thread in this_process.threads():
        os.sched_setaffinity(thread.id, {first})


def measure(extraction: Extraction, out: Path, spread: bool) -> str:
    """One run of its own."""
    clock, cores = Clock(spread), os.sched_getaffinity(0)
    controller: Any = extraction.controller
    infer = controller.infer
    controller.infer = clock.around(infer)
    try:
        with clock.around_players():
            extraction.run(out)
    finally:
        controller.infer = infer
        os.sched_setaffinity(0, cores)
    return clock.words


def main() -> None:
    """Each subject with simulators beside it, and without."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", default="tiny,large")
    parser.add_argument("--items", type=int, default=12)
    parser.add_argument("--max-steps", type=int, default=20)
    parser.add_argument("--tokens", choices=("pooled", "all"), default="pooled")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--spread", action="store_true")
    options = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.1f} on {len(os.sched_getaffinity(0))} cores; device {options.device}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        suite = build_suite(folder / "suite", ["color"], options.items)
        base = ExtractSettings(
            "pi0-tiny", suite=suite.folder, scene=SceneSpec(max_steps=options.max_steps), tokens=options.tokens,
            device=options.device,
        )  # fmt: skip
        for subject in options.subjects.split(","):
            settings = base
            if subject != "tiny":
                checkpoint = str(written("pi0", folder / subject, FULL if subject == "full" else LARGER))
                settings = base.changed(
                    model="pi0",
                    checkpoint=checkpoint,
                    random_weights=True,
                    options={"statistics": "bridge"},
                    **({"dtype": "bfloat16"} if subject == "full" else {}),
                )
            prepared = prepare(settings.changed(batch="auto"))
            print(f"{subject}: {prepared.calibration.words}", flush=True)
            print(
                f"  simulators beside it: {measure(prepared, folder / f'{subject}-beside', options.spread)}",
                flush=True,
            )
            alone = prepare(settings.changed(env_workers=0, batch=prepared.calibration.batch))
            print(f"  none beside it:       {measure(alone, folder / f'{subject}-alone', False)}", flush=True)


if __name__ == "__main__":
    main()
