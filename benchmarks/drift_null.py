"""How often drift has a verdict of its own where neither run holds an answer.

    python benchmarks/drift_null.py [--draws 20]

A draw is two runs of 12 categories with 24 items in both layouts, and two neighbouring layers of twelve random
features. Folds, choice of C and fits are those of `probe-kit train`, with 39 permutations. Each verdict must stay
at 5 % or less; a category that is not one of them is *not shown in either* or *not clear*.
"""

import argparse
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from probe_kit.hooks.contract.sites import Site
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.study import measure_drift
from probe_kit.train import ArrayRun, train_probes

CATEGORIES, ITEMS, LAYERS, WIDTH, PERMUTATIONS = 12, 24, 2, 12, 39
WRONG = ("kept", "transfer not shown", "forgotten", "learned")


def episodes() -> pd.DataFrame:
    """Two layouts of every item; an item is a group of its own."""
    rows = [
        {
            "episode_id": f"{category}-{item}:{layout}",
            "item_id": f"{category}-{item}",
            "group_id": f"{category}-{item}",
            "category": f"c{category}",
            "layout": layout,
            "side_correct": ("left", "right")[(item + (layout == "swapped")) % 2],
            "outcome": "correct",
            "side_placed": "left",
            "first_frame_sha256": f"{category}-{item}:{layout}",
        }
        for category in range(CATEGORIES)
        for item in range(ITEMS)
        for layout in ("original", "swapped")
    ]
    return pd.DataFrame(rows)


def random_run(folder: Path, table: pd.DataFrame, generator: np.random.Generator) -> ArrayRun:
    """A run without an answer; neighbouring layers are correlated 0.9."""
    values = generator.standard_normal((len(table), WIDTH))
    features = {}
    for layer in range(LAYERS):
        features[Site("backbone", layer), "mean"] = values
        values = 0.9 * values + np.sqrt(1 - 0.81) * generator.standard_normal(values.shape)
    run = ArrayRun(folder, "random", "null@1#000000000000", table, features)
    train_probes(run, permutations=PERMUTATIONS, controls=(), jobs=1)
    return run


def main() -> None:
    """Draw, count verdicts, and print their shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=20)
    draws, table, verdict_counts = parser.parse_args().draws, episodes(), Counter[str]()
    for draw in range(draws):
        generator = np.random.default_rng(draw)
        with TemporaryDirectory() as home:
            before, after = (random_run(Path(home) / name, table, generator) for name in ("before", "after"))
            verdict_counts.update(drift.verdict for drift in measure_drift(before, after))
    total = verdict_counts.total()
    for verdict, count in verdict_counts.most_common():
        above = binomtest(count, total, SIGNIFICANCE, alternative="greater").pvalue
        warning = f"; more than 5 %? p = {above:.3f}" if verdict in WRONG else ""
        print(f"{verdict}: {count} of {total} ({count / total:.1%}){warning}")


if __name__ == "__main__":
    main()
