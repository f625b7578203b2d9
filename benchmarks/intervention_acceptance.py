"""What an intervention must find in the organisms: every property of the list, true, undecided or false.

    python benchmarks/intervention_acceptance.py FOLDER [--seed 0] [--items 24] [--steps N] [--loop 4]

Draws a suite of its own seed, has every organism of `probe_kit.demo.pipeline` act on it, fits probes, intervenes.
What is true of each is taken from there; places and layers from what is found. --steps plays shorter episodes:
enough for all that is read off first actions, and the closed loop then repeats those. --loop: items per category
that are played again. Finished work in FOLDER is reused. An undecided verdict is neither true nor false. Exits
with 1 unless every property is true.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from probe_kit.demo.pipeline import (
    FULL,
    ORGANISMS,
    TRAINED,
    UNTRAINED_NETWORK,
    Agreement,
    Organism,
    findings,
    probe_organism,
)
from probe_kit.errors import CaptureChangedActionError
from probe_kit.intervene import (
    ClosedLoop,
    Interchange,
    InterventionResult,
    PatchEffect,
    ReplayFiles,
    Steering,
    run_intervention,
)
from probe_kit.intervene.kinds.base import Intervention
from probe_kit.runs import Run
from probe_kit.suite import Suite, build_suite

ABSENT = "counting"
"""A category of which nothing was trained."""


@dataclass(frozen=True)
class Property:
    """Whether one property holds, and what was seen. holds: None for a verdict that is undecided."""

    name: str
    holds: bool | None
    measured: str

    def __str__(self) -> str:
        word = {True: "true", None: "undecided", False: "FALSE"}[self.holds]
        return f"{word:12}  {self.name}: {self.measured}"


@dataclass(frozen=True)
class Trial:
    """The trained organism's run, and what is true of it. used, unused: its categories."""

    run: Run
    source: ReplayFiles
    used: tuple[str, ...]
    unused: tuple[str, ...]

    def result_of(self, intervention: Intervention) -> InterventionResult:
        """The result of one intervention; a stored one is loaded."""
        return run_intervention(self.run, intervention, self.source)


def acted(organism: Organism, suite: Suite, folder: Path, steps: int | None, untrained: Run | None) -> Run:
    """The organism's episodes, probes and `follow`; what `demo --compare` made of the same suite is reused."""
    shorter = organism if steps is None else replace(organism, max_steps=steps)
    run, _ = probe_organism(shorter, suite, folder, FULL.permutations, lambda _: lambda *_: None, untrained)
    return run


def verdicts(runs: Sequence[tuple[Organism, Run]]) -> Iterator[Property]:
    """Every organism and category."""
    holds: dict[Agreement, bool | None] = {"true": True, "undecided": None, "wrong": False}
    for finding in findings(runs):
        use = finding.row.image_swap.use
        moved = "" if use is None else f"; {use.reason}"
        observed = f"{finding.measured} (truth: {finding.expected}){moved}"
        yield Property(f"verdict of {finding.organism}, {finding.category}", holds[finding.agreement], observed)


def maps(trial: Trial, last: int) -> Iterator[Property]:
    """Where the answer passes: the whole at the beginning, nothing at the end, nowhere what is not used."""
    categories = (*trial.used, *trial.unused)
    effects = trial.result_of(Interchange(categories=categories))
    check = effects.certificate["replay"]
    yield Property(
        "clean inferences are the run's bit for bit", check["equal"] == check["compared"] > 0,
        f"{check['equal']} of {check['compared']}",
    )  # fmt: skip
    end = f"backbone.{last:02d}"
    for category in categories:
        rows = {(row.sites, row.role): row for row in effects.effects if row.category == category}
        unread = rows[end, "all"]
        yield Property(
            f"{category}: {end} is read by nothing",
            unread.max_action_change == 0 and unread.fires > unread.no_op_fires == 0,
            f"largest change {unread.max_action_change:g}; {unread.fires} fires moved tokens "
            f"{unread.relative_change:.2f} norms",
        )  # fmt: skip
        located = [row.name for row in rows.values() if row.is_localised]
        yield Property(
            f"{category}: passes somewhere" if category in trial.used else f"{category}: passes nowhere",
            bool(located) == (category in trial.used), ", ".join(located) or "nowhere",
        )  # fmt: skip
        if category in trial.used:
            full_effect = rows["backbone.00", "all"].effect
            yield Property(
                f"{category}: all tokens of the first layer are the whole exchange",
                full_effect is not None and abs(full_effect - 1) < 0.01, formatted_share(full_effect),
            )  # fmt: skip


def last_located(trial: Trial) -> tuple[str, str] | None:
    """The last place, and there the role with the largest effect, of what is located in every used category."""
    effects = trial.result_of(Interchange(categories=(*trial.used, *trial.unused)))
    everywhere: dict[tuple[str, str], list[float]] = {}
    for row in effects.effects:
        if row.category in trial.used and row.is_localised and row.role != "all":
            everywhere.setdefault((row.sites, row.role), []).append(row.effect or 0.0)
    least_share = {name: min(shares) for name, shares in everywhere.items() if len(shares) == len(trial.used)}
    return max(least_share, key=lambda name: (name[0], least_share[name]), default=None)


def memories(trial: Trial) -> Iterator[Property]:
    """One block is read, and the others are not."""
    effects = trial.result_of(Interchange(categories=trial.used, sites=("kv.*",), roles=("all",)))
    for category in trial.used:
        effect_by_site = {row.sites: row.effect for row in effects.effects if row.category == category}
        read = [site for site, effect in effect_by_site.items() if effect is not None and effect >= 0.95]
        other_effects = [effect for site, effect in effect_by_site.items() if site not in read]
        holds = len(read) == 1 and all(effect is not None and abs(effect) <= 0.05 for effect in other_effects)
        yield Property(
            f"{category}: the keys and values of one block carry ≥ .95, of the others ≤ .05", holds,
            ", ".join(f"{site} {formatted_share(effect)}" for site, effect in effect_by_site.items()),
        )  # fmt: skip


def directions(trial: Trial, site: str, role: str) -> Iterator[Property]:
    """Along one direction it passes, along a random one it does not; what is not used turns nothing."""
    categories = (*trial.used, *trial.unused)
    effects = trial.result_of(
        Interchange(categories=categories, sites=(site,), roles=(role,), direction="mean-difference:1", controls=1)
    )
    steered = trial.result_of(
        Steering(categories=trial.used, sites=(site,), role=role, coefficients=(4.0,), controls=1)
    )
    for category in categories:
        along, control = pair(effects.effects, category)
        if category in trial.unused:
            yield Property(
                f"{category}: rank 1 at {site} {role} turns ≤ .1",
                abs(along.net) <= 0.1,
                f"turned {along.net:+.2f}",
            )
            continue
        yield Property(
            f"{category}: rank 1 along the mean differences of positions at {site} {role} ≥ .8",
            along.effect is not None and along.effect >= 0.8, formatted_share(along.effect),
        )  # fmt: skip
        yield Property(
            f"{category}: its random control ≤ .05",
            control.effect is not None and abs(control.effect) <= 0.05, formatted_share(control.effect),
        )  # fmt: skip
        _, orthogonal = pair([row for row in steered.effects if row.coefficient != "0"], category)
        yield Property(
            f"{category}: an orthogonal direction at dose 4 turns ≤ .05", abs(orthogonal.net) <= 0.05,
            f"turned {orthogonal.net:+.2f}",
        )  # fmt: skip


def loops(trial: Trial, cell: str, items: int) -> Iterator[Property]:
    """The identity patch gives the run's own episodes again."""
    loop = ClosedLoop(
        categories=(*trial.used, *trial.unused), items=items, targets=(cell,), direction="none", controls=0
    )
    try:
        effects = trial.result_of(loop)
    except CaptureChangedActionError as error:
        yield Property("closed loop, coefficient 0: the run's own outcomes", False, str(error))
        return
    check = effects.certificate["replay"]
    yield Property(
        "closed loop, coefficient 0: the run's own outcomes, and trajectories bit for bit",
        check["outcomes_equal"] == check["episodes"] and check["equal"] == check["compared"],
        f"{check['outcomes_equal']} of {check['episodes']}; {check['equal']} of {check['compared']}",
    )


def pair(rows: Sequence[PatchEffect], category: str) -> tuple[PatchEffect, PatchEffect]:
    """The change of one category along its direction, and along the random one beside it."""
    category_rows = [row for row in rows if row.category == category]
    (first,), (second,) = (
        [row for row in category_rows if row.is_control == control] for control in (False, True)
    )
    return first, second


def formatted_share(effect: float | None) -> str:
    """A share of the whole exchange."""
    return "n/a" if effect is None else f"{effect:.3f}"


def properties(trial: Trial, runs: Sequence[tuple[Organism, Run]], loop: int) -> Iterator[Property]:
    """All of them, as they are found. runs: of every organism. loop: items that are played again."""
    yield from maps(trial, trial.run.streams["backbone"].layers - 1)
    yield from verdicts(runs)  # behind the map: nothing is called used that passes nowhere
    yield from memories(trial)
    best = last_located(trial)
    if best is None:
        yield Property("what is used passes by one role at one place", False, "nowhere in every category")
        return
    yield from directions(trial, *best)
    if loop:
        yield from loops(trial, "|".join(best), loop)


def main() -> int:
    """Make what is missing, and say of every property whether it holds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="of the suite")
    parser.add_argument("--items", type=int, default=24, help="per category")
    parser.add_argument("--steps", type=int, help="of an episode; default the scene's own")
    parser.add_argument("--loop", type=int, default=4, help="items per category of the closed loop; 0 for none")
    arguments = parser.parse_args()
    truth = dict(TRAINED.truth)
    suite = build_suite(arguments.folder / "suite", [*truth, ABSENT], arguments.items, seed=arguments.seed)
    folder, steps = arguments.folder, arguments.steps
    untrained = acted(UNTRAINED_NETWORK, suite, folder, steps, None)
    runs = [
        (
            organism,
            untrained if organism == UNTRAINED_NETWORK else acted(organism, suite, folder, steps, untrained),
        )
        for organism in ORGANISMS
    ]
    run = dict(runs)[TRAINED]
    used, unused = (tuple(name for name, of in truth.items() if of == kind) for kind in ("used", "not used"))
    trial = Trial(run, ReplayFiles(suite.folder), used, unused)
    weights = str(run.weights_sha256)[:12]
    print(f"{run.label}, weights {weights}, {run.suite}, suite seed {arguments.seed}, {arguments.items} items")
    holds = []
    for claim in properties(trial, runs, arguments.loop):
        print(claim, flush=True)
        holds.append(claim.holds)
    print(f"{holds.count(True)} of {len(holds)} hold, {holds.count(None)} undecided, {holds.count(False)} false")
    return 0 if all(holds) else 1


if __name__ == "__main__":
    raise SystemExit(main())
