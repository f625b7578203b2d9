"""Runs of which some episodes are played, and no other was begun."""

from contextlib import suppress
from pathlib import Path

from probe_kit.extract import ExtractSettings, prepare
from probe_kit.extract.extraction import play_episodes
from probe_kit.runs.store import locate


def play_first_episodes(settings: ExtractSettings, folder: Path, count: int = 1) -> None:
    """Play the first episodes alone, as a worker does.

    How much is played until an interruption from `progress` depends on the machine: episodes are written while the
    next ones are played, and all that were played are written.
    """
    played: list[int] = []
    remaining = list(range(count))

    def take() -> int | None:
        if len(played) == count:
            raise EOFError  # as an executor that hangs up
        return remaining.pop(0) if remaining else None

    address = prepare(settings).writer(locate(folder)).location.address
    with suppress(EOFError):
        play_episodes((settings, address, None), take, lambda event: played.append(event.number))
