"""The measurement of `--batch auto`: batch sizes and simulating processes, for some seconds before a run.

It decides the speed of a run and nothing that is stored, except for the float rounding of batches. A family whose
numbers batching changes more says so on its card and never gets more than the card allows.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from probe_kit._system.machine import cores_here
from probe_kit.env.arm import ACTION_SIZE
from probe_kit.errors import UsageError
from probe_kit.extract.rollout.controllers import PolicyController
from probe_kit.extract.rollout.worker import torch_threads
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.sources.player import Ending
from probe_kit.extract.sources.source import Played, Source
from probe_kit.extract.states import Fitted
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs.plan import Row

# These are choices, not measurements: they decide how long a run takes, and no number of it.
LARGEST = 64
"""The most observations per call that are tried."""
BUDGET_S = 30.0
"""The seconds after which no larger batch is tried."""
ENOUGH = 0.95
"""The share of the best rate at which a smaller batch is preferred: it needs less memory and fewer simulators."""
GAIN = 1.1
"""The least gain in rate over half the batch; a batch that brings less ends the search."""
TURNS = 3
"""The inferences' worth of actions over which a simulator is timed, if its episode lasts so long."""


@dataclass(frozen=True)
class Calibration:
    """A measurement, and the batch that it led to.

    Attributes:
        inference: The seconds of one call of the model, by batch.
        turn: The seconds in which one simulator executes the actions of one inference and draws the next picture,
            its share of setting up an episode included.
        batch: The chosen number of observations per call.
        env_workers: The chosen number of simulating processes; 0 for this process.
        waits: The share of the time in which the model is expected to wait for simulators.
    """

    inference: Mapping[int, float]
    turn: float
    batch: int
    env_workers: int
    waits: float

    def chosen_for(self, fitted: Fitted[ExtractSettings]) -> Fitted[ExtractSettings]:
        """Return the settings with the chosen batch and processes."""
        settings = fitted.settings.changed(batch=self.batch, env_workers=self.env_workers)
        return replace(fitted, settings=settings)

    @property
    def words(self) -> str:
        """The line of the plan."""
        processes = (
            f"{self.env_workers} simulating processes" if self.env_workers else "simulating in this process"
        )
        call, turn = 1e3 * self.inference[self.batch], 1e3 * self.turn
        return (
            f"batch {self.batch}, {processes} (measured: the model takes {call:.0f} ms a call, a simulator "
            f"{turn:.0f} ms a turn; the model would wait {self.waits:.0%} of the time)"
            + ("; results repeat up to rounding, --batch 1 repeats every byte" if self.batch > 1 else "")
        )


def calibrate(
    fitted: Fitted[ExtractSettings], controller: PolicyController, source: Source[Any], rows: Sequence[Row]
) -> Calibration:
    """Measure, and choose a batch and simulating processes for this machine.

    Takes `BUDGET_S` or a little more.

    Raises:
        UsageError: For settings that choose the simulating processes themselves.
    """
    settings = fitted.settings
    if settings.machine.env_workers is not None:
        raise UsageError("--batch auto chooses batch and simulating processes: leave out --env-workers")
    example = source.example(rows[0].instruction)
    most = largest_batch(controller.model.card.batch, len(rows))
    with torch_threads(controller.threads):
        times = inference_times(lambda batch: _infer(controller, example, batch), most)
    return choose(times, _turn(settings, controller, source, rows[0]), cores_here())


def largest_batch(of_card: int | None, episodes: int) -> int:
    """Return the largest batch to try: two groups take turns, so that it is half of the episodes at most."""
    return max(1, min(LARGEST, of_card or LARGEST, episodes // 2))


def inference_times(infer: Callable[[int], object], most: int) -> dict[int, float]:
    """Return seconds per call by batch, 1, 2, 4 … up to `most`, while they bring more and the budget lasts.

    A batch that exceeds the memory ends the search; with a single observation that is an error.
    """
    began, times = perf_counter(), dict[int, float]()
    batch = 1
    while batch <= most:
        try:
            infer(batch)  # the first call of a shape chooses kernels and allocates
            # The shorter of two: other jobs on the machine can only lengthen a call.
            times[batch] = min(_seconds(partial(infer, batch)) for _ in range(2))
        except MemoryError:
            if batch == 1:
                raise
            break
        half = times.get(batch // 2)
        if half is not None and 2 * half < GAIN * times[batch]:
            break
        if perf_counter() - began > BUDGET_S:
            break
        batch *= 2
    return times


def choose(inference: Mapping[int, float], turn: float, cores: int) -> Calibration:
    """Return the smallest batch near the best rate, where one group of simulators works while the model infers.

    A core is left to the model. With one core in all, processes bring nothing and everything stays in this one.
    """
    hands = max(1, cores - 1)

    def simulating(batch: int) -> float:
        return turn * -(-batch // hands)  # a group takes as many turns one after another as its fullest core

    def rate(batch: int) -> float:
        """Return observations per second: the slower of model and simulators, which alternate, sets the pace."""
        seconds = inference[batch]
        return batch / (max(seconds, simulating(batch)) if cores > 1 else seconds + batch * turn)

    best = max(map(rate, inference))
    batch = min(size for size in inference if rate(size) >= ENOUGH * best)
    spent = batch / rate(batch)
    return Calibration(
        dict(inference), turn, batch, 2 * batch if cores > 1 else 0, max(0.0, 1 - inference[batch] / spent)
    )


def _infer(controller: PolicyController, example: Observation, batch: int) -> None:
    from torch.cuda import OutOfMemoryError

    try:
        controller.run_preflight([example] * batch, list(range(batch)))
    except OutOfMemoryError as error:
        raise MemoryError(str(error)) from error


def _turn(settings: ExtractSettings, controller: PolicyController, source: Source[Any], row: Row) -> float:
    """Return a simulator's seconds per inference, with zero actions; setting up counts once per episode."""
    player = source.play(Played())()
    try:
        setting_up = _seconds(lambda: player.begin(row, False))
        if controller.capture_only:
            return setting_up
        # Short enough that the episode does not end while it is timed.
        steps = min(controller.execute, max(1, settings.scene.max_steps // (TURNS + 1)))
        actions = np.zeros((steps, ACTION_SIZE), np.float32)
        began, turns = perf_counter(), 0
        while turns < TURNS:
            turns += 1
            if isinstance(player.advance(actions), Ending):
                break
        per_step = (perf_counter() - began) / (turns * steps)
    finally:
        player.close()
    return per_step * controller.execute + setting_up / settings.most_inferences(controller.execute)


def _seconds(work: Callable[[], object]) -> float:
    began = perf_counter()
    work()
    return perf_counter() - began
