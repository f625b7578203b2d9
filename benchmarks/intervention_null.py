"""False alarms: how often is something found in policies that know nothing, or with shuffled labels?

    python benchmarks/intervention_null.py FOLDER [--twins 5] [--items 12] [--categories …] [--shuffles 100]

Random twins of the embedded policy, each with weights of its own, act for a few steps on a drawn suite; `follow`
and an interchange at every backbone layer and role are stored with each run. A *cell* is one test: a category for
`follow`, a category, place and role for the interchange (family-wise, so that a category counts once for its
smallest). Labels are shuffled by item on what is stored. Prints found / cells and the one-sided binomial p of more
than 5 %.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from probe_kit.env import SceneSpec
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.intervene import Answers, Follow, Interchange, Source, intervene_on
from probe_kit.intervene.following import following
from probe_kit.intervene.passing import passing
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.suite import build_suite


@dataclass
class Count:
    """Cells, and those in which something was found."""

    found: int = 0
    cells: int = 0

    def note(self, found: bool) -> None:
        """One more."""
        self.found += found
        self.cells += 1

    def __str__(self) -> str:
        from scipy.stats import binomtest

        p = binomtest(self.found, self.cells, SIGNIFICANCE, alternative="greater").pvalue if self.cells else 1.0
        return f"{self.found} / {self.cells}, p of more than 5 %: {p:.3f}"


def shuffled(answers: Answers, draw: np.random.Generator) -> Answers:
    """Sides of the correct picture exchanged in a random half of the items, in both of their layouts."""
    names, item_of = np.unique(answers.items, return_inverse=True)
    turn = draw.choice((False, True), names.size)[item_of]
    return replace(
        answers, sides=np.where(turn, np.where(answers.sides == "left", "right", "left"), answers.sides)
    )


def count_outside(answers: Answers, suite: str, counts: dict[str, Count]) -> None:
    """Note every category of a `follow`."""
    for row in following(answers, suite):
        counts["follow: p < 0.05"].note(row.p_follows < SIGNIFICANCE)
        counts["follow: called following"].note(row.is_following)


def count_inside(answers: Answers, suite: str, counts: dict[str, Count]) -> None:
    """Note every place and role of an interchange."""
    rows = [row for row in passing(answers, suite) if row.p is not None and row.p_fwe is not None]
    for row in rows:
        counts["interchange: single p < 0.05"].note((row.p or 0.0) < SIGNIFICANCE)
        counts["interchange: located"].note(row.is_located)
    for category in dict.fromkeys(row.category for row in rows):
        smallest = min(row.p_fwe or 0.0 for row in rows if row.category == category)
        counts["interchange: any p_fwe < 0.05 in a category"].note(smallest < SIGNIFICANCE)


def main() -> None:
    """Make what is missing, and count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--twins", type=int, default=5)
    parser.add_argument("--items", type=int, default=12)
    parser.add_argument("--categories", default="color,shape")
    parser.add_argument("--shuffles", type=int, default=100)
    arguments = parser.parse_args()
    suite = build_suite(arguments.folder / "suite", arguments.categories.split(","), arguments.items)
    names = (
        "follow: p < 0.05", "follow: called following", "interchange: single p < 0.05", "interchange: located",
        "interchange: any p_fwe < 0.05 in a category",
    )  # fmt: skip
    of_twins, of_shuffles = ({name: Count() for name in names} for _ in range(2))
    for seed in range(arguments.twins):
        settings = ExtractSettings(
            "pi0-tiny", random_weights=True, weights_seed=seed, suite=suite.folder, scene=SceneSpec(max_steps=1),
            frames="none", env_workers=0,
        )  # fmt: skip
        run = extract_run(settings, arguments.folder / f"twin-{seed}")
        source = Source(suite.folder, weights_seed=seed)
        for asked in (Follow(), Interchange()):
            answers = intervene_on(run, asked, source).answers
            count = count_inside if asked.kind == "interchange" else count_outside
            count(answers, run.suite, of_twins)
            for number in range(arguments.shuffles):
                count(shuffled(answers, np.random.default_rng([seed, number])), run.suite, of_shuffles)
    for title, counts in (("random twins", of_twins), ("shuffled labels", of_shuffles)):
        print(title)
        for name, found in counts.items():
            print(f"  {name:45} {found}")


if __name__ == "__main__":
    main()
