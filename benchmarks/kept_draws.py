"""Draws of a simulation that outlive a stopped process: one line of JSON per seed."""

import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def kept_draws(
    folder: Path | None, name: str, seeds: Iterable[int], draw: Callable[[int], Sequence[float]]
) -> NDArray[np.float64]:
    """(seeds, numbers) `draw(seed)` of every seed; those that `folder` holds under `name` are not drawn again.

    The caller sees to it that `name` says what decides a draw. Without a folder nothing is kept.
    """
    if folder is None:
        return np.array([draw(seed) for seed in seeds])
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{re.sub(r'[^a-z0-9]+', '-', name.lower())}.jsonl"
    stored = dict(_read(path))
    with path.open("a", encoding="utf-8") as file:
        for seed in seeds:
            if seed not in stored:
                stored[seed] = [float(number) for number in draw(seed)]
                file.write(json.dumps([seed, stored[seed]]) + "\n")
                file.flush()
    return np.array([stored[seed] for seed in seeds])


def _read(path: Path) -> Iterable[tuple[int, list[float]]]:
    """Whole lines; one that a killed process left half written is drawn again."""
    if not path.exists():
        return
    text = path.read_text(encoding="utf-8")
    complete_lines = text[: text.rfind("\n") + 1]
    if complete_lines != text:
        path.write_text(complete_lines, encoding="utf-8")
    for line in complete_lines.splitlines():
        seed, numbers = json.loads(line)
        yield seed, numbers
