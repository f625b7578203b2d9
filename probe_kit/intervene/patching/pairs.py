"""Pairs of inferences: a clean one, and the one from which activations are patched into it."""

from collections.abc import Sequence
from dataclasses import dataclass

from probe_kit.intervene.patching.inference import Given
from probe_kit.intervene.replay.session import ReplaySession
from probe_kit.intervene.store.settings import InterventionSettings, items_of


@dataclass(frozen=True)
class Pair:
    """Two inferences with the same seed.

    clean: what is patched into. source: what activations are patched from; it must have as many tokens. toward:
    +1 or −1, the direction of the metric in which the source should move the output. group: the unit that is
    resampled and flipped, such as a couple of items; item: the unit that is averaged before; both may be empty
    for pairs that are independent of each other.
    """

    clean: Given
    source: Given
    seed: int = 0
    toward: int = 1
    group: str = ""
    item: str = ""


def find_pairs(session: ReplaySession, category: str, items: int | None = None) -> list[Pair]:
    """The first inferences of a category's episodes in a run, each paired with that before swapped images.

    items: how many items, both layouts of each; None for all. The metric that fits is
    `session.lateral_displacement`: metres, left positive. Every clean inference is repeated and compared with the
    action that the run executed. Raises UnknownCategoryError for a category that the run does not have,
    OtherFramesError and CaptureChangedActionError for pictures or actions that are not those of the run.
    """
    pairs = []
    for name in items_of(session.run, InterventionSettings(categories=(category,), items=items)):
        for one in session.replay_inputs(name):
            session.replay_error(one, session.act(one.seen, one.seed))
            toward = -1 if one.side_correct == "left" else 1
            pairs.append(Pair(one.seen, one.swapped, one.seed, toward, one.group_id, one.item_id))
    return pairs


def groups_and_items(pairs: Sequence[Pair]) -> tuple[list[str], list[str]]:
    """The group and the item of every pair; a pair without one is alone in its own."""
    groups = [pair.group or f"pair {at}" for at, pair in enumerate(pairs)]
    return groups, [pair.item or f"{groups[at]}, pair {at}" for at, pair in enumerate(pairs)]
