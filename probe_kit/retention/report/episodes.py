"""Episodes in the form of the report's grid: the question, the outcome, first and last frame."""

from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from probe_kit.runs.layout import FIRST_FRAME
from probe_kit.runs.reader import RunReader
from probe_kit.runs.thumbnails import count_ends, read_thumbnail

PICTURES = 4000
"""Episodes a report shows with pictures, over all runs; one full suite of 3,440 makes about 10 MB of them."""
PICTURE_BYTES = 16_000_000
"""Bytes of all pictures of a report together, as WebP; in the page they take a third more."""
BLOCK = 48
"""Number of pictures that the page decodes at a time, when the first of them is viewed."""


@dataclass(frozen=True)
class EpisodeGrid:
    """The cards and pictures of the report's grid.

    Where only the first frame is shown, it may be the left `half` of a picture.

    Attributes:
        cards: One per episode, with the number of `frames` it shows and the place of its `picture`, None without
            one.
        pictures: Base64 of the WebPs, each once, in blocks of `BLOCK`.
        note: The number of pictures that were left out and the reason, or empty.
    """

    cards: tuple[dict[str, Any], ...]
    pictures: tuple[tuple[str, ...], ...]
    note: str
    block: int = BLOCK

    def picture(self, card: Mapping[str, Any]) -> str:
        """Return the base64 of a card's WebP."""
        block, at = divmod(int(card["picture"]), self.block)
        return self.pictures[block][at]


@dataclass(frozen=True)
class _Listed:
    """An episode, its item's place among the items of its run, its picture, and the hash of its first frame."""

    card: dict[str, Any]
    rank: int
    picture: bytes | None
    first_frame: str

    @property
    def key(self) -> tuple[str, str]:
        """The run and the id of the episode."""
        return self.card["run"], self.card["id"]


def episode_grid(
    runs: Sequence[RunReader],
    names: Sequence[str],
    pictures: int = PICTURES,
    picture_bytes: int = PICTURE_BYTES,
) -> EpisodeGrid:
    """Return all episodes of all runs; with more pictures than the limits, only every k-th item keeps its own.

    Both layouts of an item keep theirs or neither, so that they can be compared.

    Args:
        runs: Runs in the order of the page.
        names: The name of each run.
        pictures: Largest number of episodes with pictures.
        picture_bytes: Largest number of bytes of all pictures, as WebP.
    """
    total = sum(len(run.episodes) for run in runs)
    stride = max(1, -(-total // pictures))
    listed = [
        episode for name, run in zip(names, runs, strict=True) for episode in _list_episodes(name, run, stride)
    ]
    stride = _fitting(listed, stride, picture_bytes)
    with_picture = _with_pictures(listed, stride)
    picture_of = _without_repeats(with_picture)
    distinct = list(dict.fromkeys(picture for picture, _ in picture_of.values()))
    positions = {picture: at for at, picture in enumerate(distinct)}
    cards = tuple(
        {**episode.card, "picture": positions[picture_of[episode.key][0]], "half": picture_of[episode.key][1]}
        if episode.key in picture_of
        else {**episode.card, "picture": None}
        for episode in listed
    )
    encoded = [b64encode(picture).decode() for picture in distinct]
    blocks = tuple(tuple(encoded[start : start + BLOCK]) for start in range(0, len(encoded), BLOCK))
    return EpisodeGrid(cards, blocks, _note(len(with_picture), total, stride, pictures, picture_bytes))


def _without_repeats(listed: Sequence[_Listed]) -> dict[tuple[str, str], tuple[bytes, bool]]:
    """Return by episode its picture, and whether it shows the left half of one.

    A model that did not act has the first frame alone: another episode's picture holds the same one on the left.
    """
    pairs = {
        episode.first_frame: episode.picture
        for episode in reversed(listed)
        if episode.card["frames"] == 2 and episode.first_frame
    }
    picture_of = {}
    for episode in listed:
        pair = pairs.get(episode.first_frame) if episode.card["frames"] == 1 else None
        picture_of[episode.key] = (pair or episode.picture or b"", pair is not None)
    return picture_of


def _list_episodes(name: str, run: RunReader, stride: int) -> Iterator[_Listed]:
    episodes = run.episodes
    ranks = {item: rank for rank, item in enumerate(dict.fromkeys(episodes["item_id"]))}
    for position, row in enumerate(episodes.to_dict("records")):
        rank = ranks[row["item_id"]]
        number = int(row.get("episode", position))
        picture = read_thumbnail(run.location, number) if rank % stride == 0 else None
        card = {
            "run": name,
            "id": row["episode_id"],
            "category": row["category"],
            "layout": row["layout"],
            "outcome": row["outcome"],
            "instruction": row.get("instruction") or "",
            "side": row["side_correct"],
            "answer": row.get("target_concept") or "",
            "unmoved": bool(row.get("never_moved", False)),
            "asked": "parse" in row,
            "frames": count_ends(row),
        }
        yield _Listed(card, rank, picture, str(row.get(FIRST_FRAME) or ""))


def _with_pictures(listed: Sequence[_Listed], stride: int) -> list[_Listed]:
    return [episode for episode in listed if episode.picture is not None and episode.rank % stride == 0]


def _fitting(listed: Sequence[_Listed], step: int, most: int) -> int:
    """Return the smallest multiple of `step` that keeps at most so many bytes of pictures, or one item's."""
    last = max((episode.rank for episode in listed), default=0) + step
    for stride in range(step, last, step):
        pictures = {picture for picture, _ in _without_repeats(_with_pictures(listed, stride)).values()}
        if sum(map(len, pictures)) <= most:
            return stride
    return last


def _note(with_picture: int, total: int, stride: int, pictures: int, picture_bytes: int) -> str:
    if with_picture == total:
        return ""
    if with_picture == 0:
        return "The runs keep no frames. By default probe-kit extract stores two of every episode."
    if stride > 1:
        return (
            f"Pictures of {with_picture} of {total} episodes: above {pictures}, or {picture_bytes / 1e6:.0f} MB "
            f"of them, a report keeps those of every {stride}th question, in both layouts, to stay small. The "
            "others are listed without."
        )
    return f"Pictures of {with_picture} of {total} episodes; the others were played without storing frames."
