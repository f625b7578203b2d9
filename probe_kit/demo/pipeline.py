"""Model organisms, which validate the pipeline, and the stages of `probe-kit demo`.

`vlm-tiny` answers and does not act: it was trained on questions of Color, Shape, State and Traffic (*known*), and
of nothing else. `pi0-tiny` is made of its backbone. It was trained to act on Color and Shape (*used*); the actions
of State questions went to a random side (*not used*). `pi0-tiny-state` differs in that they followed the answer
(*used*). The early checkpoint has the VLM's backbone and an action expert of random weights (*does not decide*);
untrained networks know nothing (*absent*).
"""

import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, get_args

from rich.text import Text

from probe_kit._system.drafts import write_whole
from probe_kit._tables.numbers import number, percent
from probe_kit._tables.table import Cell, Table, group_headings
from probe_kit._terminal.console import markup
from probe_kit.extract import AskSettings, ExtractSettings, ask_run, extract_run
from probe_kit.extract.prompts import TEMPLATES
from probe_kit.extract.sources.player import reusing_processes
from probe_kit.intervene import ImageSwap, ReplayFiles, run_intervention
from probe_kit.retention import RetentionRow, RetentionTable, retention_table
from probe_kit.retention.columns.columns import FOLLOWS, MARGIN
from probe_kit.retention.columns.text import exceeds_text, readable, retention_value, verdict
from probe_kit.retention.displays import layer_curve
from probe_kit.retention.report import write_report
from probe_kit.runs import Run
from probe_kit.runs.layout import VIDEOS
from probe_kit.suite import Suite, build_suite
from probe_kit.train import ProbeResults, train_probes

NamedProgress = Callable[[str], Callable[..., None]]
Truth = str
"""A behaviour of `UseVerdict`, or `does not decide`, `absent`, `known` or `not shown`."""
Agreement = Literal["true", "undecided", "wrong"]
"""The agreement of a verdict with the truth.

An undecided verdict claims no behaviour: it is neither true nor wrong.
"""
DOES_NOT_DECIDE: Truth = "does not decide"
"""The truth of an action expert of random weights: nothing was trained to choose a side by the answer.

Nothing was trained to ignore the answer either, and random weights pass some of it on. How much is not known.
"""
COMPATIBLE: Mapping[Truth, tuple[str, ...]] = {
    DOES_NOT_DECIDE: (
        "not used", "moves with it, does not decide", "against: moves with it, does not decide",
    ),
}  # fmt: skip
"""The verdicts that are true with a truth, by truth; for all other truths, their own words alone."""


@dataclass(frozen=True)
class Organism:
    """A model by its name, and the verdict that is true of it in each category.

    A category that `truth` does not name is `not shown` for a model that answers and `absent` for any other.

    Attributes:
        folder: Name of the folder of its run.
        weights_seed: Seed of the random weights.
        truth: Pairs of a category and the truth.
        answers: Whether it answers questions and does not act.
        max_steps: Actions per episode; None for as many as its scene has.
        view: The tokens whose mean is probed.
    """

    name: str
    folder: str
    model: str
    random_weights: bool = False
    weights_seed: int = 0
    truth: tuple[tuple[str, Truth], ...] = ()
    answers: bool = False
    max_steps: int | None = None
    view: str = "mean"

    def expected(self, category: str) -> Truth:
        """Return the verdict that is true of a category by construction."""
        return dict(self.truth).get(category, "not shown" if self.answers else "absent")


TRAINED = Organism(
    "trained", "run", "pi0-tiny", truth=(("color", "used"), ("shape", "used"), ("state", "not used"))
)
STATE_USED = Organism(
    "State used",
    "run-state-used",
    "pi0-tiny-state",
    truth=(("color", "used"), ("shape", "used"), ("state", "used")),
)
SHORT = 8
"""Actions of organisms that were not trained to act: two inferences; their verdict needs only the first."""
EARLY = Organism(
    "early",
    "run-early",
    "pi0-tiny-early",
    truth=(("color", DOES_NOT_DECIDE), ("shape", DOES_NOT_DECIDE), ("state", DOES_NOT_DECIDE)),
    max_steps=SHORT,
    view="mean:language",  # where a VLM answers; nothing was trained that would take it from there
)
UNTRAINED_NETWORK = Organism(
    "untrained network", "run-untrained", "pi0-tiny", random_weights=True, max_steps=SHORT
)
OTHER_TWINS = tuple(
    replace(UNTRAINED_NETWORK, name=f"untrained network {seed}", folder=f"run-untrained-{seed}", weights_seed=seed)
    for seed in (1, 2)
)
ORGANISMS = (TRAINED, STATE_USED, EARLY, UNTRAINED_NETWORK, *OTHER_TWINS)
VLM = Organism(
    "vlm",
    "run-vlm",
    "vlm-tiny",
    truth=(("color", "known"), ("shape", "known"), ("state", "known"), ("traffic", "known")),
    answers=True,
)


@dataclass(frozen=True)
class OrganismVerdict:
    """The verdict of the instrument on one organism and category, and the truth."""

    organism: str
    category: str
    expected: Truth
    measured: Truth
    row: RetentionRow

    @property
    def agreement(self) -> Agreement:
        """The verdict compared with the truth: true, undecided or wrong."""
        if self.measured in COMPATIBLE.get(self.expected, (self.expected,)):
            return "true"
        return "undecided" if self.measured == "undecided" else "wrong"


def settings_of(organism: Organism, suite: Suite) -> ExtractSettings:
    """Return the settings with which an organism that acts plays `suite`."""
    return ExtractSettings(
        organism.model,
        suite=suite.folder,
        random_weights=organism.random_weights,
        weights_seed=organism.weights_seed,
        max_steps=organism.max_steps,
        video="first",
    )


def source_of(organism: Organism, suite: Suite) -> ReplayFiles:
    """Return where interventions find the organism and its pictures, with the seed of its untrained weights."""
    return ReplayFiles(suite.folder, weights_seed=organism.weights_seed)


def probe_organism(
    organism: Organism,
    suite: Suite,
    folder: Path,
    permutations: int,
    stage: NamedProgress,
    untrained: Run | None = None,
) -> tuple[Run, ProbeResults]:
    """Return the organism's run on `suite`, in `folder`, and its probes, compared with random features.

    The effects of exchanged pictures are stored too, and finished work is reused.

    Args:
        organism: A model that acts.
        suite: The questions that are played.
        folder: Folder of all organisms; the run gets the organism's own folder in it.
        permutations: Permutations of the labels, for the p-values of the probes.
        stage: Gives a progress callback (done, total, …) for a stage of this name.
        untrained: Run of an untrained network, as a control; None for no such control.
    """
    run = extract_run(
        settings_of(organism, suite), folder / organism.folder, progress=stage(f"episodes, {organism.name}")
    )
    progress = stage(f"probing sites, {organism.name}")
    results = train_probes(
        run,
        views=(organism.view,),
        permutations=permutations,
        controls=("random-features",),
        suite=suite.folder,
        untrained=untrained,
        progress=progress,
    )
    progress = stage(f"exchanging pictures, {organism.name}")
    run_intervention(run, ImageSwap(), source_of(organism, suite), progress=progress)
    return run, results


def ask_vlm(organism: Organism, suite: Suite, folder: Path, stage: NamedProgress) -> Run:
    """Return the run of a VLM on `suite`, in the prompt nearest to an instruction; finished work is reused."""
    settings = AskSettings(organism.model, suite=suite.folder, prompt=TEMPLATES["p2"])
    return ask_run(settings, folder / organism.folder, progress=stage(f"questions, {organism.name}"))


def findings(runs: Sequence[tuple[Organism, Run]]) -> list[OrganismVerdict]:
    """Return the verdict and the truth for every category of every organism's run."""
    rows = [(organism, row) for organism, run in runs for row in retention_table([run]).rows]
    trained_acts = any(verdict(row) == "used" for organism, row in rows if organism == TRAINED)
    return [
        OrganismVerdict(
            organism.name, row.category, organism.expected(row.category), measure_truth(row, trained_acts), row
        )
        for organism, row in rows
    ]


def measure_truth(row: RetentionRow, another_acts: bool) -> Truth:
    """Return the row's verdict; where only a category that follows is lacking, another organism's counts as one.

    Args:
        row: The row of one category in the organism's own table.
        another_acts: Whether the trained one acts on some category. It has the same scene, questions and network,
            so that following would be seen in every other. A policy that was not trained to act follows nowhere by
            itself.
    """
    use, reading = row.image_swap.use, readable(row)
    if use is None or (use.is_bounded and reading in ("absent", "not shown")):
        return "absent" if reading == "not shown" else reading  # so few items cannot show that it is absent
    if use.lacks_control and another_acts:
        return "not used"
    return f"{'against: ' * use.reversed}{use.behaviour}"


def organism_table(findings: Sequence[OrganismVerdict]) -> Table:
    """Return one line per organism and category: the truth, the verdict, and the numbers behind it."""
    notes = [count_agreements([finding.agreement for finding in findings])]
    notes.append("accuracies in %, retention with its interval")
    if any(finding.expected == DOES_NOT_DECIDE for finding in findings):
        either = " and ".join(f"*{verdict}*" for verdict in COMPATIBLE[DOES_NOT_DECIDE][:2])
        notes.append(f"*{DOES_NOT_DECIDE}*: the action expert was not trained; {either} are both true of it")
    numbers = ("SR %", "± Δ", "follow / reversal %", "backbone", "p", "exceeds", "action", "retention [95 %]")
    headings = group_headings(
        ("", ("policy",)),
        ("Verdicts", ("category", "expected", "measured", "agreement")),
        ("What they rest on", numbers),
    )
    return Table.of("Model organisms", headings, list(map(_cells, findings)), notes=notes)


def count_agreements(agreements: Sequence[Agreement]) -> str:
    """Return a sentence such as `20 of 24 verdicts are true, 4 undecided, none is wrong`."""
    true, left_open, wrong = (agreements.count(agreement) for agreement in get_args(Agreement))
    return (
        f"{true} of {len(agreements)} verdicts are true, {left_open} undecided, "
        f"{wrong or 'none'} {'are' if wrong > 1 else 'is'} wrong"
    )


def _cells(finding: OrganismVerdict) -> tuple[Cell | str, ...]:
    row = finding.row
    return (
        finding.organism, finding.category, finding.expected, finding.measured,
        Cell(finding.agreement, alarm=finding.agreement == "wrong"),
        Cell(row.success.sr, percent), MARGIN.cell(row), FOLLOWS.cell(row), Cell(row.backbone.score, percent),
        Cell(row.backbone.p_fwe, partial(number, digits=3)), exceeds_text(row.backbone),
        Cell(row.action.score, percent), retention_value(row),
    )  # fmt: skip


# -- the demo ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Size:
    """The extent of a demo.

    Attributes:
        items: Number of items by category.
        permutations: Permutations of the labels, for the probes.
    """

    items: Mapping[str, int]
    permutations: int


QUICK = Size({"color": 12, "state": 24, "counting": 12}, permutations=100)
"""A category that is used, one that is known and not used, and one that was never trained.

*Not used* is shown with 11 independent groups of items or more, so that State has twice as many items.
"""
FULL = Size(dict.fromkeys(("color", "shape", "state", "counting"), 24), permutations=200)
"""The size on which organisms are compared."""


@dataclass(frozen=True)
class Demo:
    """The products of the demo.

    Attributes:
        folder: Holds all of them.
        vlm_run: The run of the VLM, which answered the questions.
        run: The run of the policy.
        table: The retention table of both runs.
    """

    folder: Path
    vlm_run: Run
    run: Run
    table: RetentionTable

    def next_steps(self) -> Text:
        """Return lines that name the files to look at and the commands to try."""
        lines: list[str | Text] = [
            markup("[bold]Look at[/] {}  everything on one page, in a browser", self.folder / "report.html"),
            f"        {self.folder / 'layer_curves.png'}  where the answer can be read, layer by layer",
            f"        {self.folder / 'episode.gif'}  what one episode looks like",
            f"        {self.folder / 'table.md'}  every table",
            f"        {self.run.path}  the run: open_run({str(self.run.path)!r}), plain zarr.open or xarray",
            markup("[bold]Try[/]     probe-kit suite show            the questions"),
            "        probe-kit extract --model expert --items 4    a policy that knows the answers",
            "        probe-kit models                the models that can be probed",
        ]
        if self.run.random_weights:
            random = "The policy has random weights:"
            lines.insert(0, markup("[bold yellow]{}[/] expect SR near 0 and no signal.", random))
        return Text("\n").join(line if isinstance(line, Text) else Text(line) for line in lines)

    def viewer(self) -> Text:
        """Return one line: the command that shows both runs episode by episode."""
        runs = (shlex.quote(str(run.path)) for run in (self.run, self.vlm_run))
        return markup("[bold]Open[/]    probe-kit view {} {}", *runs)


@reusing_processes()
def compare_organisms(folder: Path, stage: NamedProgress) -> list[OrganismVerdict]:
    """Judge the VLM and every organism on the questions of `FULL`.

    Args:
        folder: Holds the suite and every run; a second call reuses finished work.
        stage: Gives a progress callback (done, total, …) for a stage of this name.
    """
    suite = _questions(folder, FULL, stage)
    # The first untrained network is a control of all others.
    control, _ = probe_organism(UNTRAINED_NETWORK, suite, folder, FULL.permutations, stage)
    runs = [(VLM, ask_vlm(VLM, suite, folder, stage))]
    for organism in ORGANISMS:
        run = control
        if organism != UNTRAINED_NETWORK:
            run, _ = probe_organism(organism, suite, folder, FULL.permutations, stage, control)
        runs.append((organism, run))
    return findings(runs)


def _questions(folder: Path, size: Size, stage: NamedProgress) -> Suite:
    return build_suite(folder / "suite", tuple(size.items), size.items, progress=stage("drawing questions"))


@reusing_processes()
def run_demo(folder: Path, stage: NamedProgress, size: Size = QUICK) -> Demo:
    """Make suite, answers, episodes, probes, table, figure, film and report; called again, it continues.

    Args:
        folder: Folder of all products.
        stage: Gives a progress callback (done, total, …) for a stage of this name.
        size: Items and permutations; by default 1 to 2 minutes of work on two cores.
    """
    suite = _questions(folder, size, stage)
    vlm_run = ask_vlm(VLM, suite, folder, stage)
    run, results = probe_organism(TRAINED, suite, folder, size.permutations, stage)
    table = retention_table([vlm_run, run])
    layer_curve(results).savefig(folder / "layer_curves.png")
    write_whole(folder / "table.md", table.to_markdown())
    write_report([vlm_run, run], folder / "report.html", table)
    film = next((run.path / VIDEOS).glob("*.gif"))
    shutil.copyfile(film, folder / "episode.gif")
    return Demo(folder, vlm_run, run, table)
