"""Checks of batches and of what an observation must hold."""

from dataclasses import replace

from probe_kit.errors import ObservationError
from probe_kit.hooks.conformance.check import check, refused, require_close
from probe_kit.hooks.conformance.subject import Subject


@check(
    "A batch gives what its rows give one by one.",
    "Mask padding, and take each row's randomness from its seed; or declare batch=1 in the card.",
)
def a_batch_equals_its_rows_one_by_one(subject: Subject) -> None:
    observations = subject.observations
    if subject.model.card.batch == 1:
        with refused("two observations where card.batch is 1", ObservationError, says="at most 1"):
            subject.run(observations)
        return
    together = subject.run(observations)
    for row, observation in enumerate(observations):
        alone = subject.run_row(observation, row)
        require_close(together[row], alone, subject.tolerance, f"numbers of row {row} in a batch")


@check(
    "An observation without what the card needs is refused.",
    "Call `self.check(observations, seeds)` first in `act` or `read`, and name inputs in the card's `needs`.",
)
def an_observation_without_what_is_needed_is_refused(subject: Subject) -> None:
    bare = replace(subject.observations[0], intrinsics=None, cameras={})
    if not subject.model.card.needs - {"state"}:
        subject.run([bare])
        return
    with refused("an observation without cameras and intrinsics", ObservationError, says="reads"):
        subject.run([bare])
