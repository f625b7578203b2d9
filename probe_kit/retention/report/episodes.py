"""Episodes as the report's grid needs them: what was asked, how it ended, first and last frame."""

from base64 import b64encode
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from probe_kit.extract.store.thumbnails import read_thumbnail
from probe_kit.train.reader import RunReader

PICTURES = 4000
"""Episodes a report shows with pictures, over all runs; one full suite of 3,440 makes about 10 MB of them."""


@dataclass(frozen=True)
class EpisodeGrid:
    """cards: one per episode. note: what was left out and why, empty if nothing."""

    cards: tuple[dict[str, Any], ...]
    note: str


def episode_grid(runs: Sequence[RunReader], names: Sequence[str], pictures: int = PICTURES) -> EpisodeGrid:
    """All episodes of all runs; with more than `pictures` of them, only every k-th item keeps its pictures.

    Both layouts of an item keep theirs or neither, so that they can be compared.
    """
    total = sum(len(run.episodes) for run in runs)
    stride = max(1, -(-total // pictures))
    cards = tuple(card for name, run in zip(names, runs, strict=True) for card in _cards(name, run, stride))
    return EpisodeGrid(cards, _note(cards, total, stride, pictures))


def _cards(name: str, run: RunReader, stride: int) -> Iterator[dict[str, Any]]:
    episodes = run.episodes
    ranks = {item: rank for rank, item in enumerate(dict.fromkeys(episodes["item_id"]))}
    for position, row in enumerate(episodes.to_dict("records")):
        shown = ranks[row["item_id"]] % stride == 0
        picture = _picture(run, int(row.get("episode", position))) if shown else None
        yield {
            "run": name,
            "id": row["episode_id"],
            "category": row["category"],
            "layout": row["layout"],
            "outcome": row["outcome"],
            "instruction": row.get("instruction") or "",
            "side": row["side_correct"],
            "answer": row.get("target_concept") or "",
            "other": row.get("distractor_concept") or "",
            "unmoved": bool(row.get("never_moved", False)),
            "picture": picture,
        }


def _picture(run: RunReader, number: int) -> str | None:
    """Base64 of the WebP, or None if the run keeps none."""
    encoded = read_thumbnail(run.location, number)
    return None if encoded is None else b64encode(encoded).decode()


def _note(cards: Sequence[dict[str, Any]], total: int, stride: int, pictures: int) -> str:
    kept = sum(card["picture"] is not None for card in cards)
    if kept == total:
        return ""
    if kept == 0:
        return "The runs keep no frames. By default probe-kit extract stores two of every episode."
    if stride > 1:
        return (
            f"Pictures of {kept} of {total} episodes: above {pictures} a report keeps those of every "
            f"{stride}th question, in both layouts, to stay small. The others are listed without."
        )
    return f"Pictures of {kept} of {total} episodes; the others were played without storing frames."
