"""The training loop: pi0's flow-matching loss and the auxiliary heads, resumable at any step."""

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from pi0_tiny_training.batches import Batch, Sampler
from pi0_tiny_training.heads import Heads, listening
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.models.pi0_tiny import ACTION_DIMS, CHUNK, IDLE_DIMS

SAVE_EVERY = 100
BATCH_SIZE = 32
STEADY, KICKED = "steady", "kicked"


@dataclass(frozen=True)
class Stage:
    """One cosine of the learning rate.

    deciding: share of frames that need the instruction; `deciding_at_end` in the last `end_phase` of the stage.
    acts_by_lot: train actions on the unused category too, to a side drawn by lot; otherwise not at all.
    data: which of the trainer's samplers it draws from.
    """

    steps: int
    rate: float
    acts_by_lot: bool
    deciding: float
    deciding_at_end: float
    data: str = STEADY
    last_rate: float = 1e-5
    warm_up: int = 100
    end_phase: float = 0.15

    def rate_at(self, step: int) -> float:
        """Learning rate of a step of this stage."""
        if step < self.warm_up:
            return self.rate * (step + 1) / self.warm_up
        done = (step - self.warm_up) / max(1, self.steps - self.warm_up)
        return self.last_rate + (self.rate - self.last_rate) * (1 + math.cos(math.pi * done)) / 2

    def deciding_at(self, step: int) -> float:
        """Share of deciding frames in a step of this stage."""
        return self.deciding_at_end if step > self.steps * (1 - self.end_phase) else self.deciding


STAGES = (
    Stage(7000, rate=1e-3, acts_by_lot=False, deciding=0.6, deciding_at_end=0.4),
    Stage(8000, rate=8e-4, acts_by_lot=True, deciding=0.5, deciding_at_end=0.35),
    Stage(5000, rate=6e-4, acts_by_lot=True, deciding=0.4, deciding_at_end=0.3, data=KICKED),
)
"""First to understand, then to move wherever it goes, then to grasp after a disturbance."""


class Trainer:
    """Policy, heads and optimiser of one training, which continues from `folder`."""

    def __init__(
        self,
        policy: Pi0,
        heads: Heads,
        samplers: Mapping[str, Sampler],
        stages: Sequence[Stage],
        seed: int,
        folder: Path,
    ):
        self.policy, self.heads, self.samplers = policy, heads, samplers
        self.stages, self.seed, self.folder = stages, seed, folder
        self.model = policy.network.model
        self.step = 0
        parameters = [p for p in [*self.model.parameters(), *heads.parameters()] if p.requires_grad]
        decayed = [p for p in parameters if p.ndim > 1]
        plain = [p for p in parameters if p.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": 0.01}, {"params": plain, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, betas=(0.9, 0.99))
        self._parameters = parameters
        if self._state.is_file():
            self._resume()

    @property
    def _state(self) -> Path:
        return self.folder / "training.pt"

    def steps(self) -> Iterator[dict[str, float]]:
        """Train to the end of the schedule; yields the losses of every step."""
        self.policy.network.train()
        end = 0
        for stage in self.stages:
            begin, end = end, end + stage.steps
            while self.step < end:
                losses = self._one_step(stage, self.step - begin)
                self.step += 1
                if self.step % SAVE_EVERY == 0 or self.step == end:
                    self._save()
                yield losses
        self.policy.network.eval()

    def _one_step(self, stage: Stage, step: int) -> dict[str, float]:
        rng = np.random.default_rng([self.seed, self.step])
        batch = self.samplers[stage.data].batch(rng, BATCH_SIZE, stage.deciding_at(step), stage.acts_by_lot)
        for group in self.optimiser.param_groups:
            group["lr"] = stage.rate_at(step)
        torch.manual_seed(self.seed * 1_000_003 + self.step)
        losses = self._losses(batch, stage.acts_by_lot)
        self.optimiser.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        self._keep_idle_dimensions_idle()
        nn.utils.clip_grad_norm_(self._parameters, 1.0)
        self.optimiser.step()
        return {name: float(loss.detach()) for name, loss in losses.items()}

    def _losses(self, batch: Batch, acts_by_lot: bool) -> dict[str, Tensor]:
        tokens, mask = self.policy.tokenise(batch.texts)
        model, size = self.model, len(batch.texts)
        images = [batch.pictures * 2 - 1]
        present = [torch.ones(size, dtype=torch.bool)]
        noise = torch.randn(size, CHUNK, batch.chunks.shape[-1])
        time = model.sample_time(size, "cpu")
        with listening(model) as heard:
            errors = model.forward(images, present, tokens, mask, batch.states, batch.chunks, noise, time)
        per_sample = errors[..., list(ACTION_DIMS)].mean((1, 2))
        words = mask & ~torch.isin(tokens, torch.tensor(self.policy.tokenizer.all_special_ids))
        acted = torch.ones(size) if acts_by_lot else batch.used.float()
        flow = (per_sample * acted).sum() / acted.sum().clamp(min=1)
        return {"flow": flow, **self.heads.losses(heard, batch, words)}

    def _keep_idle_dimensions_idle(self) -> None:
        if self.model.action_in_proj.weight.grad is not None:
            self.model.action_in_proj.weight.grad[:, list(IDLE_DIMS)] = 0.0

    def _save(self) -> None:
        state = {
            "step": self.step,
            "model": self.model.state_dict(),
            "heads": self.heads.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        aside = self._state.with_suffix(".writing")
        torch.save(state, aside)
        aside.replace(self._state)

    def _resume(self) -> None:
        state = torch.load(self._state, weights_only=True)
        self.model.load_state_dict(state["model"])
        self.heads.load_state_dict(state["heads"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = state["step"]


def follow(
    trainer: Trainer,
    log: Path,
    report: Callable[[str], None],
    milestones: Mapping[int, Callable[[], None]],
    every: int = 20,
) -> None:
    """Train, writing the mean losses of every `every` steps to a CSV file; `milestones` run after their step."""
    recent: list[dict[str, float]] = []
    for losses in trainer.steps():
        recent.append(losses)
        milestones.get(trainer.step, lambda: None)()
        if trainer.step % every == 0:
            means = {name: sum(row[name] for row in recent) / len(recent) for name in losses}
            recent.clear()
            _append(log, {"step": trainer.step, **means})
            report(f"step {trainer.step} " + " ".join(f"{name} {value:.3f}" for name, value in means.items()))


def _append(log: Path, row: dict[str, float]) -> None:
    new = not log.is_file()
    with log.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)
