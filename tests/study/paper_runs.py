"""Runs whose rates are those that the paper prints, so that our tables can be compared with its numbers."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from probe_kit.hashing import derive_seed
from tests.retention.asked_runs import ASK, SaidRun

FOLDER = Path(os.environ.get("PROBE_KIT_SHARED", Path(__file__).parents[3] / "shared")) / "data" / "paper"
SUITE = "paper@1#0123456789ab"
SIDES = ("left", "right")


def paper(name: str) -> dict[str, Any]:
    """`tables` as the paper prints them, or `recomputed` numbers; skipped where they are not at hand."""
    file = FOLDER / f"paper-{name}.json"
    if not file.is_file():
        pytest.skip(
            f"no numbers of the paper at {file} (set PROBE_KIT_SHARED); they are not part of the repository"
        )
    numbers: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return numbers


def episodes_of(category: str, episodes: int, rates: tuple[float, float], seed: int) -> pd.DataFrame:
    """Episodes of a category whose rates where left and right is correct are exactly `rates`, in percent.

    What no whole number of episodes gives is the share of one episode.
    """
    items = np.arange(episodes) // 2
    swapped = np.arange(episodes) % 2
    side = (items + swapped) % 2
    share = np.zeros(episodes)
    draw = np.random.default_rng(derive_seed("paper", category, seed))
    for at, rate in enumerate(rates):
        side_episodes = draw.permutation(np.flatnonzero(side == at))
        right = rate / 100 * side_episodes.size
        share[side_episodes[: int(right)]] = 1
        if right % 1 > 1e-9:
            share[side_episodes[int(right)]] = right % 1
    names = [f"{category}-{item}" for item in items]
    hit = share > 0.5
    placed = np.where(hit, side, 1 - side)
    return pd.DataFrame(
        {
            "episode_id": [f"{name}:{'os'[at]}" for name, at in zip(names, swapped, strict=True)],
            "item_id": names,
            "group_id": names,
            "category": category,
            "layout": np.array(["original", "swapped"])[swapped],
            "side_correct": np.array(SIDES)[side],
            "outcome": np.where(hit, "correct", "wrong"),
            "side_placed": np.array(SIDES)[placed],
            "share_correct": share,
            "share_wrong": 1 - share,
            "share_oob": 0.0,
        }
    )


def run_of(
    name: str,
    rates: Mapping[str, float | tuple[float, float]],
    items: Mapping[str, Any],
    is_answer_run: bool = False,
) -> SaidRun:
    """A run with these rates by category, of both sides or of each; items: the paper's table of episodes."""
    tables = [
        episodes_of(
            category, items[category]["episodes"], rate if isinstance(rate, tuple) else (rate, rate), len(name)
        )
        for category, rate in rates.items()
    ]
    table = pd.concat(tables, ignore_index=True)
    if is_answer_run:
        table = table.assign(
            parse="letter", parse_tier="strict", option_mass=1.0, letter_bias=0.0, near_tie=False, side_word=False,
            outcome_logits=table["outcome"], side_logits=table["side_placed"],
            outcome_debiased=table["outcome"], side_debiased=table["side_placed"],
        )  # fmt: skip
    settings = {"ask": ASK} if is_answer_run else {}
    return SaidRun(Path("/paper") / name, name, SUITE, table, {}, settings=settings)
