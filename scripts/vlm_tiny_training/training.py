"""A training loop that resumes at any step."""

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Protocol

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from torch import Tensor, distributed, multiprocessing, nn

BATCH = 64
SAVE_EVERY = 100
Report = Callable[[str], None]


@dataclass(frozen=True)
class Stage[Setting]:
    """One cosine of the learning rate. setting: what else the learner's batches depend on."""

    steps: int
    rate: float
    setting: Setting
    last_rate: float = 1e-5
    warm_up: int = 100

    def rate_at(self, step: int) -> float:
        """Learning rate of a step of this stage."""
        if step < self.warm_up:
            return self.rate * (step + 1) / self.warm_up
        progress = (step - self.warm_up) / max(1, self.steps - self.warm_up)
        return self.last_rate + (self.rate - self.last_rate) * (1 + math.cos(math.pi * progress)) / 2


class Learning[Setting](Protocol):
    """A network, and its losses on batches that it draws."""

    network: nn.Module

    def losses(self, rng: np.random.Generator, setting: Setting, size: int) -> dict[str, Tensor]:
        """Of one batch of that many samples; their sum is trained on."""


class Trainer[Setting]:
    """Learner and optimiser of one training, which continues from `path`."""

    def __init__(
        self,
        learner: Learning[Setting],
        stages: Sequence[Stage[Setting]],
        seed: int,
        path: Path,
        batch: int = BATCH,
    ) -> None:
        self.learner, self.stages, self.seed, self.path, self._batch = learner, stages, seed, path, batch
        self.step = 0
        self._parameters = [p for p in learner.network.parameters() if p.requires_grad]
        decayed = [p for p in self._parameters if p.ndim > 1]
        plain = [p for p in self._parameters if p.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": 0.01}, {"params": plain, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, betas=(0.9, 0.99))
        if path.is_file():
            self._resume()

    def steps(self) -> Iterator[dict[str, float]]:
        """Train to the end of the schedule; yields the losses of every step."""
        self.learner.network.train()
        end = 0
        for stage in self.stages:
            begin, end = end, end + stage.steps
            while self.step < end:
                losses = self._one_step(stage, self.step - begin)
                self.step += 1
                if self.step % SAVE_EVERY == 0 or self.step == end:
                    self._save()
                yield losses
        self.learner.network.eval()

    def _one_step(self, stage: Stage[Setting], step: int) -> dict[str, float]:
        for group in self.optimiser.param_groups:
            group["lr"] = stage.rate_at(step)
        torch.manual_seed((self.seed * 1_000_003 + self.step) * 101 + rank())
        rng = np.random.default_rng([self.seed, self.step, rank()])
        losses = self.learner.losses(rng, stage.setting, self._batch // workers())
        self.optimiser.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        self._share_gradients()
        nn.utils.clip_grad_norm_(self._parameters, 1.0)
        self.optimiser.step()
        return {name: float(loss.detach()) for name, loss in losses.items()}

    def _share_gradients(self) -> None:
        """The mean over all workers, which so stay equal; of what some did not use, their share is zero."""
        if workers() == 1:
            return
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in self._parameters]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        distributed.all_reduce(flat)
        flat /= workers()
        parts = flat.split([gradient.numel() for gradient in gradients])
        for parameter, part in zip(self._parameters, parts, strict=True):
            parameter.grad = part.view_as(parameter)

    def _save(self) -> None:
        if rank() > 0:
            return
        state = {
            "step": self.step,
            "network": self.learner.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        aside = self.path.with_suffix(".writing")
        torch.save(state, aside)
        aside.replace(self.path)

    def _resume(self) -> None:
        state = torch.load(self.path, weights_only=True)
        self.learner.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = state["step"]


def workers() -> int:
    """Processes that share every batch."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def rank() -> int:
    """Which of them this one is; number 0 writes."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def together(count: int, work: Callable[[], None]) -> None:
    """Do `work` in so many processes, forked from this one, which share every batch."""
    if count == 1:
        work()
        return
    with NamedTemporaryFile() as meeting:
        arguments = (count, f"file://{meeting.name}", work)
        multiprocessing.start_processes(_joined, arguments, count, start_method="fork")


def _joined(number: int, count: int, meeting: str, work: Callable[[], None]) -> None:
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", init_method=meeting, rank=number, world_size=count)
    work()
    distributed.barrier()
    distributed.destroy_process_group()


def follow[Setting](
    trainer: Trainer[Setting],
    log: Path,
    report: Report,
    milestones: Mapping[int, Callable[[], None]] | None = None,
    every: int = 50,
) -> None:
    """Train, writing the mean losses of every `every` steps to a CSV file; `milestones` run after their step."""
    recent: list[tuple[str, float]] = []
    for losses in trainer.steps():
        if rank() > 0:
            continue
        recent += losses.items()
        (milestones or {}).get(trainer.step, lambda: None)()
        if trainer.step % every == 0:
            names = list(dict.fromkeys(name for name, _ in recent))
            means = {
                name: float(np.mean([loss for loss_name, loss in recent if loss_name == name])) for name in names
            }
            recent.clear()
            _append(log, trainer.step, means)
            report(f"{log.stem} {trainer.step} " + " ".join(f"{name} {mean:.3f}" for name, mean in means.items()))


def _append(log: Path, step: int, means: Mapping[str, float]) -> None:
    """One row per step and loss: not every batch has every loss."""
    new = not log.is_file()
    with log.open("a", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        if new:
            writer.writerow(("step", "loss", "mean"))
        writer.writerows((step, name, mean) for name, mean in means.items())


def draw_losses(log: Path, picture: Path, batch: int = BATCH) -> None:
    """The loss curves of a training as a PNG file."""
    figure, axis = plt.subplots(figsize=(8, 4), layout="constrained")
    for name, rows in pd.read_csv(log).groupby("loss", sort=False):
        axis.plot(rows["step"], rows["mean"].rolling(4, min_periods=1).mean(), label=name)
    axis.set(xlabel=f"step of {batch} samples", ylabel="loss, mean of 200 steps", yscale="log")
    axis.legend()
    figure.savefig(picture, dpi=120)
    plt.close(figure)
