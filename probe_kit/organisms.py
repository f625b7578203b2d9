"""Model organisms: policies of which the truth is known by construction, to test the instrument on.

`pi0-tiny` was trained to act on Color and Shape (*used*); the answer to State questions was made readable in
its backbone and never trained into an action (*encoded, unused*); nothing was trained for the other categories
(*absent*). Its early checkpoint and its random twin know nothing yet. `vlm-tiny` reads and does not act: it was
trained to answer questions of Color, Shape, State and Traffic (*known*), and of nothing else.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

from probe_kit.extract import AskSettings, ExtractSettings, Run, ask_run, extract_run
from probe_kit.extract.asking.templates import TEMPLATES
from probe_kit.intervene import Follow, Source, Verdict, intervene_on
from probe_kit.retention import RetentionRow, retention
from probe_kit.retention.cells import FOLLOWED_COLUMNS, beats, bounded_value, margin_value, number, percent
from probe_kit.retention.success import Regime
from probe_kit.suite import Suite
from probe_kit.train import ProbeResults, train_probes

if TYPE_CHECKING:
    from probe_kit.fitting_tables import Cell, FittingTable

NamedProgress = Callable[[str], Callable[..., None]]
Truth = Verdict | Literal["known", "unknown"]


@dataclass(frozen=True)
class Organism:
    """A model by its name, and the verdict that is true of it per category; `absent` or `unknown` if not named.

    folder: what its run is called. asked: it reads and does not act.
    """

    name: str
    folder: str
    model: str
    random_weights: bool = False
    truth: tuple[tuple[str, Truth], ...] = ()
    asked: bool = False

    def expected(self, category: str) -> Truth:
        """What is true by construction."""
        return dict(self.truth).get(category, "unknown" if self.asked else "absent")


TRAINED = Organism(
    "trained", "run", "pi0-tiny", truth=(("color", "used"), ("shape", "used"), ("state", "encoded, unused"))
)
RANDOM_TWIN = Organism("random twin", "run-random-twin", "pi0-tiny", random_weights=True)
ORGANISMS = (TRAINED, Organism("early", "run-early", "pi0-tiny-early"), RANDOM_TWIN)
READER = Organism(
    "reader",
    "run-reader",
    "vlm-tiny",
    truth=(("color", "known"), ("shape", "known"), ("state", "known"), ("traffic", "known")),
    asked=True,
)


@dataclass(frozen=True)
class Finding:
    """What the instrument says about one organism and category, beside the truth."""

    organism: str
    category: str
    expected: Truth
    measured: Truth
    row: RetentionRow

    @property
    def agrees(self) -> bool:
        """Whether the instrument tells the truth."""
        return self.expected == self.measured


def verdict(row: RetentionRow) -> Truth:
    """What a row of the retention table says: is the answer in the backbone, and does the policy act on it?

    In the backbone: its best site beats chance, family-wise, and every control that was run. Acted on: the action
    follows the pictures when these are exchanged; without a stored intervention, the SR is in the regime of
    knowledge. *Acted on, not found* is a contradiction, and true of no policy: the instrument missed what the
    policy plainly reads. A model that was asked knows a category in which it answers in the regime of knowledge.
    """
    if row.kind == "asks":
        return "known" if row.regime == Regime.KNOWLEDGE else "unknown"
    if row.used is not None:
        return cast("Verdict", row.used)
    if row.regime == Regime.KNOWLEDGE:
        return "used" if row.prefix_signal else "acted on, not found"
    return "encoded, unused" if row.prefix_signal else "absent"


def probed(
    organism: Organism,
    suite: Suite,
    folder: Path,
    permutations: int,
    stage: NamedProgress,
    twin: Run | None = None,
) -> tuple[Run, ProbeResults]:
    """The organism's run on `suite`, in `folder`, and its probes, held against binding.

    What exchanged pictures do is stored too, and finished work is reused. stage: gives a progress callback (done,
    total, …) for a stage of this name. twin: a run to hold it against too.
    """
    settings = ExtractSettings(
        organism.model, suite=suite.folder, random_weights=organism.random_weights, video="first"
    )
    run = extract_run(settings, folder / organism.folder, progress=stage(f"episodes, {organism.name}"))
    progress = stage(f"probing sites, {organism.name}")
    results = train_probes(
        run, permutations=permutations, controls=("binding",), suite=suite.folder, twin=twin, progress=progress
    )
    intervene_on(run, Follow(), Source(suite.folder), progress=stage(f"exchanging pictures, {organism.name}"))
    return run, results


def answered(organism: Organism, suite: Suite, folder: Path, stage: NamedProgress) -> Run:
    """What a reader answers on `suite`, in the prompt nearest to an instruction; finished work is reused."""
    settings = AskSettings(organism.model, suite=suite.folder, prompt=TEMPLATES["p2"])
    return ask_run(settings, folder / organism.folder, progress=stage(f"questions, {organism.name}"))


def compare(suite: Suite, folder: Path, permutations: int, stage: NamedProgress) -> list[Finding]:
    """Judge the reader and every organism on `suite`, the trained ones against the random twin too.

    Arguments as of `probed`.
    """
    twin, _ = probed(RANDOM_TWIN, suite, folder, permutations, stage)
    runs = [(READER, answered(READER, suite, folder, stage))]
    runs += [
        (one, twin if one == RANDOM_TWIN else probed(one, suite, folder, permutations, stage, twin)[0])
        for one in ORGANISMS
    ]
    return [
        Finding(organism.name, row.category, organism.expected(row.category), verdict(row), row)
        for organism, run in runs
        for row in retention([run]).rows
    ]


def to_rich(findings: Sequence[Finding]) -> "FittingTable":
    """One line per organism and category: the truth, the verdict, and the numbers behind it."""
    from probe_kit.fitting_tables import FittingTable, Part

    agree = sum(finding.agrees for finding in findings)
    return FittingTable(
        title="Model organisms",
        caption=f"{agree} of {len(findings)} verdicts are true; accuracies in %, retention bounded",
        name="policy",
        names=tuple(finding.organism for finding in findings),
        styles=("",) * len(findings),
        parts=(
            Part(
                "Verdicts",
                ("category", "expected", "measured", ""),
                tuple(map(_verdict_cells, findings)),
            ),
            Part(
                "What they rest on",
                ("SR %", "± Δ", "follows / against", "backbone", "p", "beats", "action", "retention [95 %]"),
                tuple(map(_number_cells, findings)),
            ),
        ),
    )


def _verdict_cells(finding: Finding) -> "tuple[Cell, ...]":
    from probe_kit.fitting_tables import Cell

    mark = Cell("✓", "green") if finding.agrees else Cell("✗", "red")
    return Cell(finding.category), Cell(finding.expected), Cell(finding.measured), mark


def _number_cells(finding: Finding) -> "tuple[Cell, ...]":
    from probe_kit.fitting_tables import Cell

    row = finding.row
    texts = (
        percent(row.sr), margin_value(row), FOLLOWED_COLUMNS[0][1](row), percent(row.prefix_accuracy),
        number(row.prefix_p_fwe, 3),
        beats(row), percent(row.action_accuracy), bounded_value(row),
    )  # fmt: skip
    return tuple(map(Cell, texts))
