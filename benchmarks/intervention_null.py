"""False alarms: how often is something found in policies that know nothing, or with shuffled labels?

    python benchmarks/intervention_null.py FOLDER [--networks 50] [--inside 10] [--items 12] [--categories …]
                                              [--shuffles 100] [--model pi0-tiny]

Untrained networks of a policy, each with weights of its own, infer on the first frames of a drawn suite, drawn
once: `follow` for all of them, an interchange at every backbone layer and role for the first `--inside`. Labels
are shuffled by item on what the trained policy itself does, once per shuffle. A *cell* is one test: a category
for `follow`; a category, place and role for the interchange. Cells of one interchange share its episodes, so
that the family-wise count, one cell a category and policy, is the independent one. Every policy's answers are
kept in FOLDER: the same command continues. Prints found / cells and the one-sided binomial p of more than 5 %.
"""

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from probe_kit.env import SceneSpec
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks import Policy, load_policy
from probe_kit.intervene import ConditionOutcomes, ImageSwap, Interchange, ReplayFiles, ReplaySession
from probe_kit.intervene.kinds.image_swap import image_swap_effects
from probe_kit.intervene.kinds.interchange import patch_effects
from probe_kit.intervene.open_session import open_session
from probe_kit.intervene.outcomes import arrays_from_bytes
from probe_kit.intervene.pairs import Pair
from probe_kit.intervene.replay import replay
from probe_kit.intervene.stored import EPISODES, Measurement
from probe_kit.intervene.verdict import classify_behaviour
from probe_kit.runs import Run
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.suite import Suite, build_suite

NAMES = (
    "image swap: p < 0.05", "image swap: called used", "interchange: single p < 0.05", "interchange: located",
    "interchange: any p_fwe < 0.05 in a category",
)  # fmt: skip


@dataclass
class Count:
    """Cells, and those in which something was found."""

    hits: int = 0
    cells: int = 0

    def note(self, is_hit: bool) -> None:
        """One more."""
        self.hits += is_hit
        self.cells += 1

    def __str__(self) -> str:
        from scipy.stats import binomtest

        p = binomtest(self.hits, self.cells, SIGNIFICANCE, alternative="greater").pvalue if self.cells else 1.0
        return f"{self.hits} / {self.cells}, p of more than 5 %: {p:.3f}"


def shuffled(answers: ConditionOutcomes, draw: np.random.Generator) -> ConditionOutcomes:
    """Sides of the correct picture exchanged in a random half of the items, in both of their layouts."""
    names, item_of = np.unique(answers.items, return_inverse=True)
    turn = draw.choice((False, True), names.size)[item_of]
    return replace(
        answers, sides=np.where(turn, np.where(answers.sides == "left", "right", "left"), answers.sides)
    )


def measured(answers: ConditionOutcomes, suite: str) -> Measurement:
    """Return what effects are computed from."""
    files = {EPISODES: answers.to_bytes()}
    run: Any = SimpleNamespace(seed_text=suite, settings={})
    return Measurement(run, {}, files.__getitem__)


def count_outside(answers: ConditionOutcomes, suite: str, counts: dict[str, Count]) -> None:
    """Note every category of a `follow`."""
    for row in image_swap_effects(measured(answers, suite)):
        counts["image swap: p < 0.05"].note(row.follow_p < SIGNIFICANCE)
        use = classify_behaviour(row, None)
        counts["image swap: called used"].note(use.is_used and not use.reversed)


def count_inside(answers: ConditionOutcomes, suite: str, counts: dict[str, Count]) -> None:
    """Note every place and role of an interchange."""
    rows = [
        row for row in measured(answers, suite).rows(patch_effects) if row.p is not None and row.p_fwe is not None
    ]
    for row in rows:
        counts["interchange: single p < 0.05"].note((row.p or 0.0) < SIGNIFICANCE)
        counts["interchange: located"].note(row.is_localised)
    for category in dict.fromkeys(row.category for row in rows):
        smallest = min(row.p_fwe or 0.0 for row in rows if row.category == category)
        counts["interchange: any p_fwe < 0.05 in a category"].note(smallest < SIGNIFICANCE)


@dataclass
class Frames:
    """First frames of a suite, drawn once, and what a policy does on them. run: whose episodes they are."""

    run: Run
    bench: ReplaySession
    questions: Sequence[Pair]

    def answers(self, policy: Policy, intervention: ImageSwap | Interchange, file: Path) -> ConditionOutcomes:
        """The outcomes of one policy; loaded from `file` if it exists."""
        if not file.is_file():
            self.bench.policy = policy
            conditions = intervention.conditions(self.bench)
            parts = [replay(self.bench, [question], conditions) for question in self.questions]
            outcomes = ConditionOutcomes.joined(parts)
            partial = file.with_suffix(".partial")
            partial.write_bytes(outcomes.to_bytes())
            partial.replace(file)
        return ConditionOutcomes(**arrays_from_bytes(file.read_bytes()))


def run_of(folder: Path, suite: Suite, model: str) -> Run:
    """Episodes of one step, whose places and seeds every policy is asked on."""
    settings = ExtractSettings(
        model, random_weights=True, suite=suite.folder, scene=SceneSpec(max_steps=1), frames="none", env_workers=0
    )
    return extract_run(settings, folder / "run")


def report(title: str, counts: dict[str, Count]) -> None:
    """Print one table."""
    print(title)
    for name, count in counts.items():
        if count.cells:
            print(f"  {name:45} {count}")


def measure(frames: Frames, model: str, folder: Path, networks: Iterable[int], inside: int, shuffles: int) -> None:
    """Make what is missing, and count."""
    of_networks, of_shuffles = ({name: Count() for name in NAMES} for _ in range(2))
    suite = frames.run.suite
    for seed in networks:
        policy = load_policy(model, random_weights=True, weights_seed=seed)
        count_outside(frames.answers(policy, ImageSwap(), folder / f"follow-{seed}.npz"), suite, of_networks)
        if seed < inside:
            outcomes = frames.answers(policy, Interchange(), folder / f"interchange-{seed}.npz")
            count_inside(outcomes, suite, of_networks)
        print(f"network {seed}: {of_networks[NAMES[0]]}; {of_networks[NAMES[2]]}", flush=True)
    trained = load_policy(model)
    outside = frames.answers(trained, ImageSwap(), folder / "follow-trained.npz")
    within = frames.answers(trained, Interchange(), folder / "interchange-trained.npz")
    for number in range(shuffles):
        draw = np.random.default_rng(number)
        count_outside(shuffled(outside, draw), suite, of_shuffles)
        count_inside(shuffled(within, draw), suite, of_shuffles)
    report("untrained networks", of_networks)
    report("the trained policy, labels shuffled by item", of_shuffles)


def main() -> None:
    """Draw the frames and measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--networks", type=int, default=50)
    parser.add_argument("--inside", type=int, default=10)
    parser.add_argument("--items", type=int, default=12)
    parser.add_argument("--categories", default="color,shape,state,counting")
    parser.add_argument("--shuffles", type=int, default=100)
    parser.add_argument("--model", default="pi0-tiny")
    arguments = parser.parse_args()
    suite = build_suite(arguments.folder / "suite", arguments.categories.split(","), arguments.items)
    run = run_of(arguments.folder, suite, arguments.model)
    with open_session(run, ReplayFiles(suite.folder)) as bench, bench.ready():
        items = dict.fromkeys(run.episodes["item_id"].astype(str))
        questions = [replace(pair, stored=None) for item in items for pair in bench.pairs(item)]
        frames = Frames(run, bench, questions)
        networks = range(arguments.networks)
        measure(frames, arguments.model, arguments.folder, networks, arguments.inside, arguments.shuffles)


if __name__ == "__main__":
    main()
