"""Inputs without content: a camera that is black, stuck or there twice, and a state that never changes.

Probes of such an input give scores like those of any other. It is a warning, because only the user knows what a
scene should show. Simulating processes import this, no array store.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import list_names, plural
from probe_kit._system.escaping import terminal_safe

CODEC_NOISE = 8
"""The grey levels, of 255, by which a pixel of a small picture may differ although nothing does.

Small pictures are means at 32 × 32. Measured on 96 × 96 and 256 × 256 pixels through AV1 (CRF 30, lerobot's
default) and H.264 (CRF 30): a black camera differs by at most 1, one colour with noise of 6 levels by at most 8, a
frozen picture by at most 5. A bright square of a 24th of the width that moves changes a pixel by more than 150.
"""
FEWEST = 3
"""The frames of an episode, spread over it, from which on an unchanged picture says something."""
AT_REST = 0.05
"""The share of its range over all episodes within which every number of a state stays while an arm rests."""
MOST_EPISODES = 24
"""The episodes of a run whose stored pictures are looked at, spread over the run."""
EPISODE, FILE = "episode", "file"
"""The units of sentences. Files are those of a folder of pictures, which are compared with each other."""
_NAMED = 4


@dataclass(frozen=True, eq=False)
class EpisodeFrames:
    """The inputs at some frames of an episode.

    Attributes:
        name: The episode, as sentences name it.
        pictures: (n, K, S, S, 3) uint8 small pictures of every camera.
        state: (n, D); None where there is none.
        hashes: Of every frame, the hash of the whole picture of each camera; empty where they are unknown.
            Pictures that went through no video are the same only if they are equal bit for bit.
    """

    name: str
    pictures: NDArray[np.uint8]
    state: NDArray[np.floating] | None = None
    hashes: Sequence[Sequence[bytes]] = ()

    @property
    def count(self) -> int:
        """The number of frames."""
        return len(self.pictures)

    def is_still(self, camera: int, is_lossy: bool) -> bool:
        """Whether a camera shows one picture at all frames."""
        if self.hashes and not is_lossy:
            return len({frame[camera] for frame in self.hashes}) == 1
        return _range(self.pictures[:, camera]) <= (CODEC_NOISE if is_lossy else 0)


def content_notes(
    episodes: Sequence[EpisodeFrames], cameras: Sequence[str], lossy: Collection[str] = (), unit: str = EPISODE
) -> list[str]:
    """Return a sentence for every input without content; none where some frames cannot tell.

    A picture that is the same at the beginning of every episode is none: scenes are set up alike. Neither is a
    picture that does not change while the arm rests.

    Args:
        episodes: Some episodes, with frames that are spread over each.
        cameras: The names of the K cameras.
        lossy: Those whose pictures went through a video.
        unit: The noun of an episode.
    """
    episodes = [episode for episode in episodes if episode.count]
    if not episodes:
        return []
    notes = [
        note
        for number, camera in enumerate(cameras)
        for note in _notes_of_camera(episodes, number, terminal_safe(camera), camera in lossy, unit)
    ]
    for (first, camera), (second, other) in combinations(enumerate(cameras), 2):
        pairs = [episode.pictures[:, [first, second]].astype(np.int16) for episode in episodes]
        differ = max(int(np.abs(pair[:, 0] - pair[:, 1]).max()) for pair in pairs)
        has_content = any(not _is_uniform(episode.pictures[:, first]).all() for episode in episodes)
        if has_content and differ <= CODEC_NOISE:
            notes.append(f"{terminal_safe(camera)} and {terminal_safe(other)} show the same picture")
    return notes + list(_notes_of_state(episodes, unit))


def _notes_of_camera(
    episodes: Sequence[EpisodeFrames], camera: int, name: str, is_lossy: bool, unit: str
) -> Iterator[str]:
    """Yield why the pictures of one camera are without content: of one colour, or stuck."""
    uniform = [_is_uniform(episode.pictures[:, camera]) for episode in episodes]
    count = sum(episode.count for episode in episodes)
    everything = np.concatenate([episode.pictures[:, camera] for episode in episodes])
    if all(part.all() for part in uniform) and _range(everything) <= CODEC_NOISE:
        yield f"{name} shows nothing but {_colour(everything)}, in all {plural(count, 'picture')} looked at"
        return
    blank = []
    if not all(part.all() for part in uniform):
        pairs = zip(episodes, uniform, strict=True)
        blank = [
            episode for episode, part in pairs if part.all() and _range(episode.pictures[:, camera]) <= CODEC_NOISE
        ]
        if blank:
            pictures = np.concatenate([episode.pictures[:, camera] for episode in blank])
            colour = _colour(pictures) if _range(pictures) <= CODEC_NOISE else "one colour"
            yield f"{name} shows nothing but {colour} in {_list_episodes(blank, episodes, unit)}"
    is_folder = unit == FILE and len(episodes) >= FEWEST
    watched = [episode for episode in episodes if (is_folder or episode.count >= FEWEST) and episode not in blank]
    moving = _moving(watched)
    stuck = [episode for episode in moving if episode.is_still(camera, is_lossy)]
    if len(watched) > 1 and _join_frames(watched).is_still(camera, is_lossy):
        yield f"{name} shows the same picture in all {plural(len(watched), unit)} looked at"
    elif stuck and not is_folder:
        yield f"{name} shows one picture from beginning to end of {_list_episodes(stuck, moving, unit)}"


def _join_frames(episodes: Sequence[EpisodeFrames]) -> EpisodeFrames:
    """Return the frames of several episodes as those of one."""
    hashes = [frame for episode in episodes for frame in episode.hashes]
    return EpisodeFrames("", np.concatenate([episode.pictures for episode in episodes]), None, hashes)


def _moving(episodes: Sequence[EpisodeFrames]) -> list[EpisodeFrames]:
    """Return the episodes in which the state moves; all where no state says anything."""
    states = [episode.state for episode in episodes if episode.state is not None]
    if len(states) < len(episodes) or not states:
        return list(episodes)
    least = AT_REST * np.ptp(np.concatenate(states), axis=0)
    if not least.any():
        return list(episodes)
    return [
        episode for episode, state in zip(episodes, states, strict=True) if (np.ptp(state, axis=0) > least).any()
    ]


def _notes_of_state(episodes: Sequence[EpisodeFrames], unit: str) -> Iterator[str]:
    states = [episode.state for episode in episodes if episode.state is not None]
    if not states or states[0].shape[1] == 0 or max(map(len, states)) < FEWEST:
        return
    everything = np.concatenate(states)
    if not np.ptp(everything, axis=0).any():
        zeros = "" if everything.any() else " (all zeros)"
        yield f"the state is the same at all {plural(len(everything), 'frame')} looked at{zeros}"
    elif all(not np.ptp(state, axis=0).any() for state in states):
        yield f"the state does not change within any of {plural(len(states), unit)} looked at"


def _is_uniform(pictures: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return whether each picture (n, S, S, 3) is of one colour, (n,)."""
    uniform: NDArray[np.bool_] = np.ptp(pictures, axis=(1, 2)).max(axis=-1) <= CODEC_NOISE
    return uniform


def _range(pictures: NDArray[np.uint8]) -> int:
    """Return the most grey levels by which a pixel differs among pictures (n, S, S, 3)."""
    return int(np.ptp(pictures, axis=0).max())


def _colour(pictures: NDArray[np.uint8]) -> str:
    levels = pictures.reshape(-1, 3).mean(axis=0).round().astype(int).tolist()
    if max(levels) <= 2 * CODEC_NOISE:
        return "black"
    return "white" if min(levels) >= 255 - 2 * CODEC_NOISE else f"one colour (RGB {', '.join(map(str, levels))})"


def _list_episodes(some: Sequence[EpisodeFrames], every: Sequence[EpisodeFrames], unit: str) -> str:
    """Return names of episodes as a sentence has them, or their number where they are all."""
    if len(some) == len(every):
        return f"all {plural(len(some), unit)} looked at" if len(some) > 1 else f"{unit} {some[0].name}"
    names = [terminal_safe(episode.name) for episode in some[:_NAMED]]
    more = [f"{len(some) - _NAMED} more"] if len(some) > _NAMED else []
    return f"{unit}{'s' * (len(some) > 1)} {list_names(names + more)} ({len(some)} of {len(every)} looked at)"
