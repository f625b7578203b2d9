"""How long GPUs wait without a model while a study is played on a Ray cluster.

    OMP_NUM_THREADS=1 python benchmarks/study_gpus.py [--gpus 2] [--models 8] [--items 8]

Needs Ray (extra `ray`), and no GPU: the cluster is started with `--gpus` of them by name, and the models run on
its cores. Half of the models have twice as many episodes as the others. A GPU waits where Ray has given it to no
model although models are left; what a model needs to start counts as its own time.
"""

import argparse
import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from probe_kit.study import load_study, plan_study
from probe_kit.study.cells import StudyFailure
from probe_kit.study.plan import StudyPlan
from probe_kit.study.playing import ModelTask, RunFinished, RunTask, play_models

STUDY = """
schema = 1
name = "gpus"
out = "{out}"

[suite]
categories = ["Color", "State"]
items = {items}

{models}
[conditions.still]
no_act = true

[[runs]]
name = "long"
models = {long}
conditions = ["still"]

[[runs]]
name = "short"
models = {short}
conditions = ["still"]
categories = ["Color"]
"""
MODEL = '[models.m{seed}]\nfamily = "pi0-tiny"\nrandom_weights = true\nweights_seed = {seed}\n\n'
EVERY_S = 0.1


def tasks_of(plan: StudyPlan) -> list[ModelTask]:
    """A task per model, which takes one GPU of the cluster and computes on the CPU."""
    tasks = []
    for planned in plan.cells:
        settings = planned.cell.settings_to_play.changed(device="cpu")
        run = RunTask(planned.cell.name, settings, planned.location, 0)
        tasks.append(ModelTask(planned.cell.model, (run,), 1, planned.missing))
    return tasks


class Waiting:
    """Samples how many GPUs no model has, while models are left and until the last has ended."""

    def __init__(self, gpus: int, models: int) -> None:
        self.gpus, self.models = gpus, models
        self.while_left: list[float] = []
        self.whole: list[float] = []
        self.ended = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)

    def __enter__(self) -> "Waiting":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _sample(self) -> None:
        import ray

        started = False
        while not self._stop.wait(EVERY_S):
            free = ray.available_resources().get("GPU", 0.0)
            started = started or free < self.gpus
            if not started:
                continue
            self.whole.append(free / self.gpus)
            if self.models - self.ended >= self.gpus:
                self.while_left.append(free / self.gpus)


def main() -> None:
    """Play once and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gpus", type=int, default=2)
    parser.add_argument("--models", type=int, default=8)
    parser.add_argument("--items", type=int, default=8)
    arguments = parser.parse_args()
    import ray

    names = [f"m{seed}" for seed in range(arguments.models)]
    with TemporaryDirectory() as folder:
        file = Path(folder) / "study.toml"
        models = "".join(MODEL.format(seed=seed) for seed in range(arguments.models))
        text = STUDY.format(
            out=f"{folder}/out", items=arguments.items, models=models, long=names[::2], short=names[1::2]
        )
        file.write_text(text.replace("'", '"'), encoding="utf-8")
        tasks = tasks_of(plan_study(load_study(file)))
        ray.init(num_cpus=arguments.gpus, num_gpus=arguments.gpus, include_dashboard=False, log_to_driver=False)
        began = time.monotonic()
        with Waiting(arguments.gpus, len(tasks)) as waiting:
            failures: list[StudyFailure] = []

            def note(event: object) -> None:
                waiting.ended += isinstance(event, RunFinished | StudyFailure)
                failures.extend([event] if isinstance(event, StudyFailure) else [])

            play_models(tasks, note, ray="auto")
        seconds = time.monotonic() - began
        ray.shutdown()
    assert not failures, failures
    left, overall = (100 * sum(shares) / len(shares) for shares in (waiting.while_left, waiting.whole))
    print(f"{len(tasks)} models on {arguments.gpus} GPUs in {seconds:.0f} s")
    print(
        f"GPUs without a model: {left:.1f} % while models are left, {overall:.1f} % from first start to last end"
    )


if __name__ == "__main__":
    main()
