"""The parts that all kinds of intervention share: settings, names of conditions, effects, tests, tables.

This file loads neither torch nor a simulator, and neither do the kinds, because tables read them without a model.
"""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np

from probe_kit._system.types import Matrix
from probe_kit._tables.content import Cell as TableCell
from probe_kit._tables.numbers import NONE as NO_NUMBER
from probe_kit._tables.numbers import Write, number, percent, with_sign
from probe_kit.env.scoring import DEFAULT_RULE
from probe_kit.errors import UsageError
from probe_kit.extract.sources.inputs import INSTRUCTION
from probe_kit.hashing import derive_seed
from probe_kit.hooks.capturing.edits import LOG_FIELDS
from probe_kit.hooks.contract.declared import InterventionKind
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.edited_cells import EditedCell
from probe_kit.intervene.further_instructions import check_further_instructions
from probe_kit.intervene.outcomes import ConditionOutcomes, Effect
from probe_kit.intervene.pairs import Pair
from probe_kit.intervene.patching.patch import Cell
from probe_kit.intervene.places import TILES
from probe_kit.intervene.replay import Condition, replay
from probe_kit.intervene.settings import FIRST_CHUNK, PER_STEP, Choice, categories_in
from probe_kit.intervene.stored import Measurement
from probe_kit.runs.direction_files import FileDirection, names_file, read_direction
from probe_kit.runs.reader import RunReader
from probe_kit.runs.run import Run
from probe_kit.statistics.bootstrap import GAINS, group_bootstrap, units_seed
from probe_kit.statistics.paired_tests import max_t
from probe_kit.suite.categories import category_of

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit._tables.table import Table
    from probe_kit.intervene.directions import Directions
    from probe_kit.intervene.sessions import ReplaySession

OPTIONS = (
    "sites", "roles", "direction", "controls", "coefficients", "target_side", "seed", "window", "readers", "heads",
    "closed_loop", "untrained",
)  # fmt: skip
"""Options of the command that a kind may take."""


# -- the kind -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Intervention(Choice, ABC):
    """One kind of intervention: its settings as fields, its conditions, and how their numbers are read.

    Subclasses set the fields without a default as attributes of the class; `kind` is their name on the command
    line. An option outside of `OPTIONS` raises UsageError.

    Attributes:
        summary: Line of help.
        position: Position in help.
        options: Options of `OPTIONS` that the kind takes, and their meaning.
        needs: Interventions that a family must support, besides those of the fields `sites` and `roles`.
        fits_always: Whether items are inferred beforehand.
        has_verdict: Whether `classify_use` classifies its rows.
        is_descriptive: Whether it edits and tests nothing.
        asks_where: Whether it edits places of the network, so that a line says which layer matters.
        needs_scene: Whether it applies to runs of the scene alone.
        categories: Categories of the run; None for all.
        items: Number of items of each category, the first ones; None for all.
        readout: Part of the policy's answer that is read, see `Readout`.
        vary: In runs without sides, the input that the source has of its donor; empty for `usual_vary`.
        frames: In runs without sides, the number of frames of an episode, evenly spaced; None for 4.
        pairs: In runs without sides, pairs of the user's own: episode and frame of the clean inference and of its
            donor.
        instructions: In runs without sides, words of other tasks for donors, beside the instructions of the run.
    """

    summary: ClassVar[str]
    position: ClassVar[int] = 100  # behind all shipped kinds, which have 1 to 9
    options: ClassVar[Mapping[str, str]] = MappingProxyType({})
    needs: ClassVar[tuple[InterventionKind, ...]] = ("edit",)
    fits_always: ClassVar[bool] = False
    has_verdict: ClassVar[bool] = False
    is_descriptive: ClassVar[bool] = False
    asks_where: ClassVar[bool] = False
    needs_scene: ClassVar[bool] = False

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if unknown := [name for name in cls.options if name not in OPTIONS]:
            raise UsageError(
                f"{cls.__name__} declares the option {unknown[0]!r}, which `probe-kit intervene` does not have; "
                f"expected some of {', '.join(OPTIONS)}"
            )

    def __post_init__(self) -> None:
        super().__post_init__()
        for pattern in ("sites", "roles"):
            # `roles` alone, without sites, may be empty: a readout of attention takes all that there are.
            if hasattr(self, "sites") and getattr(self, pattern, None) == ():
                raise UsageError(f"--kind {self.kind} needs at least one of --{pattern}; none is given")

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Return the kind as the command builds it, from the options that the user gave.

        Raises:
            UsageError: For an option with a value that does not fit.
        """
        del run
        return cls(**options)

    @property
    def patterns(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """The patterns of places that it edits, each with the roles of the tokens; none by default."""
        return tuple((site, getattr(self, "roles", ())) for site in getattr(self, "sites", ()))

    @property
    def required_capabilities(self) -> tuple[InterventionKind, ...]:
        """The interventions that a family must support for it, at its sites and roles."""
        roles = {*getattr(self, "roles", ()), *(role for _, roles in self.patterns for role in roles)}
        reads_kv = any(site.partition(".")[0] == KV_STREAM for site, _ in self.patterns)
        needed: dict[InterventionKind, bool] = {"kv": reads_kv, "tiles": not TILES.keys().isdisjoint(roles)}
        return (*self.needs, *(kind for kind, is_needed in needed.items() if is_needed))

    @property
    def fits_first(self) -> bool:
        """Whether items are inferred beforehand, for directions of tokens, erasers or a search."""
        return self.fits_always or ":" in getattr(self, "direction", "")

    @property
    def plays_episodes(self) -> bool:
        """Whether whole episodes are played again; the readout is then where the cube ends."""
        return False

    def parameters(self) -> dict[str, Any]:
        """Return its own settings as plain JSON; with the run they decide its numbers."""
        return super().parameters() | ({"readout": "episode"} if self.plays_episodes else {})

    def check_run(self, run: Run) -> None:
        """Refuse a run that the intervention does not fit.

        Raises:
            UnknownCategoryError: For a category that the run lacks.
            UsageError: For a run that does not fit.
        """
        categories_in(run, self.categories)
        if run.source.is_scene:
            if self.vary or self.frames or self.pairs or self.instructions:
                raise UsageError(
                    "--vary, --frames, --pairs and --instructions are for runs on recordings or in your own "
                    "environment; in the scene the pictures are swapped. Leave them out"
                )
        elif self.needs_scene or self.readout != FIRST_CHUNK:
            option = f"--kind {self.kind}" if self.needs_scene else f"--readout {self.readout}"
            raise UsageError(
                f"{run.location} has no correct picture on a side, which {option} needs. Take --kind interchange, "
                "or a run of the scene"
            )
        elif self.instructions:
            self._check_instructions(run)
        if self.plays_episodes and run.rule != DEFAULT_RULE:
            raise UsageError(
                f"{run.location} is read by the rule {run.rule!r}; a closed loop repeats outcomes as they were "
                f"recorded: open the run without another rule ({DEFAULT_RULE})"
            )

    def _check_instructions(self, run: Run) -> None:
        """Raise UsageError for further instructions that nothing exchanges, or that the run has already."""
        if self.varied != INSTRUCTION:
            raise UsageError(
                f"--instructions gives words, and the {self.varied} is exchanged; add --vary {INSTRUCTION}, or "
                "leave it out"
            )
        if self.pairs:
            raise UsageError(
                "--instructions gives words of donors, and --pairs names donors; leave one of both out"
            )
        check_further_instructions(self.instructions, run.episodes[INSTRUCTION].astype(str))

    def eligible_items(self, session: "ReplaySession", items: Sequence[str]) -> list[str]:
        """Return the items to which the kind applies; the others are passed over, and counted."""
        del session
        return list(items)

    @abstractmethod
    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return all conditions, in the order in which they are stored; the first one changes nothing.

        Entries on them for the certificate are put in `session.certificate`.
        """

    def play(
        self, session: "ReplaySession", pairs: Sequence[Pair], conditions: Sequence[Condition]
    ) -> ConditionOutcomes:
        """Play the conditions on some pairs, as the readout demands, or their episodes from first to last step."""
        if self.plays_episodes:
            from probe_kit.intervene.rollout import play_episodes

            return play_episodes(session, pairs, conditions)
        if self.readout == PER_STEP:
            from probe_kit.intervene.rollout import evaluate_per_step

            return evaluate_per_step(session, pairs, conditions)
        return replay(session, pairs, conditions)

    def extra_files(
        self, session: "ReplaySession", conditions: Sequence[Condition], outcomes: ConditionOutcomes
    ) -> dict[str, bytes]:
        """Return further files to store, by name; further entries go into `session.certificate`."""
        del session, conditions, outcomes
        return {}

    @staticmethod
    @abstractmethod
    def effects(measurement: Measurement) -> Sequence["Effect"]:
        """Return the rows of a stored measurement."""

    @staticmethod
    @abstractmethod
    def table(rows: Sequence[Any], context: Measurement) -> "Table":
        """Return the rows as a table for a terminal."""

    @classmethod
    def sentences(cls, rows: Sequence[Any], context: Measurement) -> list[str]:
        """Return the findings with their numbers, a sentence per category; none of a kind that only describes."""
        parts = [(name, cls.sentence(part, context)) for name, part in edits_by_category(rows).items()]
        return [f"{category_of(name).title}: {text}." for name, text in parts if text]

    @classmethod
    def findings(cls, rows: Sequence[Any], context: Measurement) -> list[str]:
        """Return the last lines of a command, `CATEGORY  verdict: what was found.`: short, one per category."""
        parts = [
            (category_of(name).title, cls.finding(part, context)) for name, part in edits_by_category(rows).items()
        ]
        width = max((len(title) for title, _ in parts), default=0)
        return [f"{title.ljust(width)}  {text}." for title, text in parts if text]

    @staticmethod
    def sentence(rows: Sequence[Any], context: Measurement) -> str:
        """Return the finding in one category with its numbers; `rows` are without controls."""
        del rows, context
        return ""

    @staticmethod
    def finding(rows: Sequence[Any], context: Measurement) -> str:
        """Return a verdict, a colon and the finding, in few words without brackets; `rows` have no controls."""
        del rows, context
        return ""

    @staticmethod
    def notes(rows: Sequence[Any]) -> list[str]:
        """Return sentences that a reader must know."""
        del rows
        return []

    @staticmethod
    def keys_in_use(run: RunReader) -> set[str] | None:
        """Return keys of the stored interventions that tables and figures read; None if none is preferred."""
        del run
        return None


NONE = "none"
"""Name for no direction: tokens are patched in full."""


@dataclass(frozen=True, kw_only=True)
class AlongDirection(Intervention):
    """An intervention along a direction, with matched random ones as controls.

    Attributes:
        takes_none: Whether tokens may be edited along no direction; an attribute of the class.
        direction: Name of the direction. `mean-difference` or `probe` is one vector per place, found in means over
            tokens without the episode that it is used on. `mean-difference:K` is K directions found in the tokens
            themselves, see `directions`. FILE#NAME is a direction of a file, see `direction_files`. Some kinds
            take `none`.
        controls: Number of random directions of the data's own covariance, orthogonal to it.
        seed: Seed of controls and folds.
        vector: Direction of a file, whose name `direction` then is; None for other directions.
    """

    takes_none: ClassVar[bool] = True

    direction: str = NONE
    controls: int = 0
    seed: int = 0
    vector: FileDirection | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if names_file(self.direction):
            vector = read_direction(self.direction)
            if vector.note:
                warnings.warn(vector.note, stacklevel=4)
            object.__setattr__(self, "vector", vector)
            object.__setattr__(self, "direction", vector.name)
        elif self.direction != NONE or not self.takes_none:
            from probe_kit.intervene.directions import check_direction

            check_direction(self.direction)
        elif self.controls:
            raise UsageError("controls are directions beside another one; choose --direction, or --controls 0")

    def fit_directions(
        self, session: "ReplaySession", cells: Sequence[Cell], patterns: Sequence[str]
    ) -> "dict[Cell, Directions]":
        """Return the direction and the random ones in every cell; see `directions.fit_directions_in_cells`."""
        from probe_kit.intervene.directions import fit_directions_in_cells

        return fit_directions_in_cells(
            session,
            cells,
            patterns,
            self.direction,
            controls=self.controls,
            seed=self.seed,
            categories=self.categories,
            vector=self.vector,
        )

    def check_run(self, run: Run) -> None:
        """Refuse a run that the intervention does not fit.

        Raises as `Intervention.check_run` too.

        Raises:
            UsageError: For a direction of an answer in a run without sides.
        """
        super().check_run(run)
        if not run.source.is_scene and self.direction != NONE and self.vector is None:
            raise UsageError(
                f"{run.location} has no correct picture on a side, so that {self.direction} is no direction "
                "there. Give one of a file: --direction FILE#NAME"
            )


# -- effects -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class EffectRow(Effect):
    """The effect of one edit in one category, with the columns that all kinds of edits have.

    Attributes:
        sites: Name of the edited place.
        role: Role of the edited tokens.
        direction: Name of the direction; empty if tokens were edited in full.
        is_control: Whether the direction is a random one.
        net: Share of episodes with a change that the kind counts, such as a flip to the target side, minus the
            share with the reverse.
        net_ci: The 95 % interval of `net`, by groups.
        max_action_change: Largest difference in any action of any episode; 0 means that all are bit for bit the
            same.
        fires: Number of edits of sites in all episodes.
        no_op_fires: Number of those edits that changed nothing.
        relative_change: Distance by which tokens were moved, in their own norms.
        key: Key of the intervention.
    """

    sites: str
    role: str
    direction: str
    is_control: bool
    n_episodes: int
    n_items: int
    net: float
    net_ci: tuple[float, float]
    max_action_change: float
    fires: int
    no_op_fires: int
    relative_change: float
    key: str = ""

    @property
    def name(self) -> str:
        """The edit in a few words."""
        return " ".join(filter(None, (self.sites, self.role, self.direction)))


def common_columns(outcomes: ConditionOutcomes, row: int, cell: EditedCell, gains: Matrix) -> dict[str, Any]:
    """Return the columns of `EffectRow` for one condition.

    Args:
        outcomes: Outcomes of one category.
        row: Row of the condition in them.
        cell: The cell that the condition edits.
        gains: (E,) 1 where an episode has the change that the kind counts with the edit only, −1 for the reverse.
    """
    logged = dict(zip(LOG_FIELDS, outcomes.edit_log[row].T, strict=True))
    norm = float((logged["norm"] * logged["fires"]).sum())
    counts = {column: value for column, value in outcomes.counts.items() if column != "n_groups"}
    return {
        **counts,
        "sites": cell.site,
        "role": cell.role,
        "direction": cell.direction,
        "is_control": cell.is_control,
        "net": float(gains.mean()),
        "net_ci": net_interval(gains, outcomes),
        "max_action_change": float(outcomes.max_action_change[row].max()),
        "fires": int(logged["fires"].sum()),
        "no_op_fires": int(logged["no_op_fires"].sum()),
        "relative_change": float((logged["change"] * logged["fires"]).sum()) / norm if norm else 0.0,
    }


def net_interval(gains: Matrix, outcomes: ConditionOutcomes) -> tuple[float, float]:
    """Return the 95 % interval by groups of the mean over episodes of (E,) gains."""
    drawn = units_seed(outcomes.groups, outcomes.seed_text)
    low, high = group_bootstrap(gains[:, None], outcomes.groups, drawn, bounds=GAINS)
    return float(low[0]), float(high[0])


class ControlTest(NamedTuple):
    """One condition compared with its controls.

    The test is one-sided, by sign flips of whole groups. Its numbers are None for a condition that is not tested.

    Attributes:
        controls: Rows of its controls.
        beyond: (E,) values of the condition minus the mean of its controls.
        t: Statistic of the test.
        p: The p-value of the condition alone.
        p_fwe: Family-wise p-value, against the largest t of the category.
    """

    controls: list[int]
    beyond: Matrix | None = None
    t: float | None = None
    p: float | None = None
    p_fwe: float | None = None


def compare_with_controls(
    values: Matrix,
    cells: Sequence[EditedCell],
    outcomes: ConditionOutcomes,
    *,
    skipped: Collection[int] = (),
    broken_controls: Collection[int] = (),
) -> list[ControlTest]:
    """Compare every condition that is no control with its own controls, in the order of the conditions.

    Args:
        values: (K, E) values that are tested to be above zero.
        cells: The cells that the K conditions edit.
        outcomes: Outcomes of one category.
        skipped: Rows that are not tested though they are no controls, such as an identity patch.
        broken_controls: Rows of controls that nothing is compared with, such as those that disrupt the task.
    """
    controls = [
        [at for at, other in enumerate(cells) if other.is_control_of(cell) and at not in broken_controls]
        for cell in cells
    ]
    tests = [ControlTest(rows) for rows in controls]
    tested = [at for at, cell in enumerate(cells) if not cell.is_control and at not in skipped]
    if not tested:
        return tests
    # Without controls an effect is compared with zero.
    beyond = np.array(
        [values[at] - values[controls[at]].mean(axis=0) if controls[at] else values[at] for at in tested]
    )
    flips = derive_seed("sign flips", outcomes.seed_text, str(outcomes.categories[0]))
    numbers = max_t(beyond, outcomes.items, outcomes.groups, flips)
    for at, excess, *statistics in zip(tested, beyond, *numbers, strict=True):
        tests[at] = ControlTest(controls[at], excess, *map(float, statistics))
    return tests


def mean_of(values: Matrix) -> float | None:
    """Return the mean of some numbers; None if there are none."""
    return float(values.mean()) if values.size else None


def edits_by_category[Row: Effect](rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Return rows by category, without controls of edits."""
    parts: dict[str, list[Row]] = {}
    for row in rows:
        if not (isinstance(row, EffectRow) and row.is_control):
            parts.setdefault(row.category, []).append(row)
    return parts


def frame_of(rows: Sequence[Effect]) -> "pd.DataFrame":
    """Return one line per row; intervals are two columns at the end."""
    import pandas as pd

    flat = []
    for row in rows:
        plain = row.to_json()
        limits = {name: plain.pop(name) or (None, None) for name in list(plain) if name.endswith("_ci")}
        ends = {
            f"{name}_{end}": pair[at] for name, pair in limits.items() for at, end in enumerate(("low", "high"))
        }
        flat.append({**plain, **ends})
    return pd.DataFrame(flat)


# -- tables and sentences ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EffectColumn[Row]:
    """A column of a table of effects.

    Attributes:
        cell: Makes the cell of a row.
        term: Its entry in the legend, `name: meaning`; empty for none.
    """

    heading: str
    cell: Callable[[Row], TableCell | str]
    term: str = ""


def effect_table[Row](
    title: str,
    names: Sequence[str],
    lines: Sequence[tuple[tuple[str, ...], Row]],
    parts: Mapping[str, Sequence[EffectColumn[Row]]],
    is_bold: Callable[[Row], bool] = lambda _: False,
    *,
    before: Iterable[str] = (),
    marks: Mapping[str, str] = MappingProxyType({}),
    after: Iterable[str] = (),
) -> "Table":
    """Return rows of effects as a table.

    Args:
        title: Title of the table.
        names: Headings of the columns that name a line.
        lines: Names of each line, and its row.
        parts: The columns by the title of their group.
        is_bold: Function that returns whether a row's names are bold.
        before: Remarks of the legend in front of the terms of the columns; empty ones are left out.
        marks: The meaning of signs that cells have.
        after: Remarks behind them; empty ones are left out.
    """
    from probe_kit._tables.table import Heading, Legend, Table

    rows: list[tuple[TableCell | str, ...]] = [
        (
            *(TableCell(text, strong=is_bold(row)) for text in (category_of(line[0]).title, *line[1:])),
            *(column.cell(row) for columns in parts.values() for column in columns),
        )
        for line, row in lines
    ]
    headings = [
        *map(Heading, names),
        *(
            Heading(column.heading, term=column.term, group=part)
            for part, columns in parts.items()
            for column in columns
        ),
    ]
    legend = Legend(tuple(before), marks, tuple(after))
    return Table.of(title, headings, rows, names=len(names), legend=legend)


def lines_of[Row: Effect](rows: Iterable[Row], name: Callable[[Row], str]) -> list[tuple[tuple[str, ...], Row]]:
    """Return rows with the names of their lines: the category, and the name of the row."""
    return [((row.category, name(row)), row) for row in rows]


def edit_of(row: EffectRow) -> str:
    """Return the category and the name of a row, with which a sentence begins."""
    return f"{category_of(row.category).title}, {row.name}"


RESOLUTION = 0.005
"""Half of the last digit that tables print of shares, rates and spreads, and of displacements in cm.

A test of signs knows no size: an effect that is 0.00 in every episode can have the smallest p there is.
"""


def rate(value: float | None) -> TableCell:
    """Return a share in percent."""
    return TableCell(value, percent)


def centimetres(metres: float | None, write: Write = number) -> TableCell:
    """Return a distance in centimetres."""
    return TableCell(None if metres is None else 100 * metres, write)


def is_resolved(*effects: float | None) -> bool:
    """Return whether any of some effects is as large as the resolution of its measure."""
    return any(effect is not None and abs(effect) >= RESOLUTION for effect in effects)


UNRESOLVED = (
    f"p –: none is given, because the effect is below {RESOLUTION}, the smallest that its measure resolves"
)
"""The entry of a legend for p-values that are not shown."""


def p_of(value: float | None, is_printed: bool = True) -> TableCell:
    """Return a p-value in two digits; a dash for None, and for the p-value of an effect that is not resolved."""
    return TableCell(value if is_printed else None, _two_digits)


def _two_digits(value: float | None) -> str:
    return NO_NUMBER if value is None else format(abs(value), ".2g")


def interval_cell(value: float | None, limits: tuple[float, float] | None, write: Write = number) -> TableCell:
    """Return a value and its interval; a dash without an interval."""
    return TableCell(None if limits is None else value, write, limits)


def signed_interval(value: float | None, limits: tuple[float, float] | None) -> TableCell:
    """Return a value with its sign and its interval; a dash without an interval."""
    return interval_cell(value, limits, with_sign)


def count_edits(names: Sequence[str], tried: int, most: int = 3) -> str:
    """Return how many edits of those that were tried have an effect, and the first of them by name."""
    if not names:
        return f"none of {tried}"
    remaining = len(names) - most
    return (
        f"{len(names)} of {tried} ({', '.join(names[:most])}{f' and {remaining} more' if remaining > 0 else ''})"
    )


def share_of_edits(rows: Sequence[EffectRow], tried: int, subject: str = "edits") -> str:
    """Return a text such as `2 of 3 edits, most at backbone.01 image`.

    Args:
        rows: Edits with an effect, at least one, the largest effect first.
        tried: Number of edits that were tried.
        subject: Noun for the edits.
    """
    first = f"{rows[0].sites} {rows[0].role}".rstrip()
    return f"{len(rows)} of {tried} {subject}, {'most ' if len(rows) > 1 else ''}at {first}"
