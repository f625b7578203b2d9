"""The retention table: several runs joined, and its output formats."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, Self, get_args

from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument, csv_of_frame, without_folders
from probe_kit._tables.formats import render
from probe_kit._tables.table import Table
from probe_kit.env.scoring import DEFAULT_RULE, SENSITIVITY_RADII, check_rule
from probe_kit.errors import NoProbesError, NoTrajectoryError, UsageError
from probe_kit.retention.behaviour import (
    TableRun,
    check_epsilons,
    chosen_wordings,
    distinct_labels,
    left_out,
    mixed_episodes,
    mixed_settings,
    scored,
    without_content,
)
from probe_kit.retention.choices import Family, Iterations, Section
from probe_kit.retention.columns.columns import averaged_fields
from probe_kit.retention.columns.summary import RunSummary, next_step, summarise_runs, summary_table
from probe_kit.retention.columns.tables import retention_tables, size_table, vlm_vla_tables, wording_tables
from probe_kit.retention.columns.text import model_name
from probe_kit.retention.compare.compare import (
    Difference,
    compare_groups,
    compare_runs,
    compare_with_vlms,
    compare_wordings,
)
from probe_kit.retention.formats import frame_of, paper_table, part_frame, peak_frame, table_json
from probe_kit.retention.rows.build import (
    RowSettings,
    RowWithEstimates,
    mean_row,
    run_rows,
    with_holm_of_targets,
)
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.runs.environment_success import EnvironmentSuccess, why_no_rates
from probe_kit.runs.layout import AT_END, CONDITION, UNEDITED
from probe_kit.runs.reader import RunReader, check_sides
from probe_kit.runs.store import Location
from probe_kit.statistics.paired_tests import holm, overlap_p
from probe_kit.statistics.sufficiency import ABSENT_BELOW
from probe_kit.train.choices import SIDES
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import is_current, load_results, load_side_results, stored_targets

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Group


@dataclass(frozen=True, repr=False)
class RetentionTable:
    """Rows per run, category and view, and per run and view their category mean.

    Runs are never averaged with each other, so no mean mixes suites. Rows of targets that are no side have no
    mean, as their metrics differ.

    Attributes:
        differences: Differences between runs, or groups of runs.
        results: The probes that the rows were made of, by location of the run and target; figures and reports of
            the table draw these.
        iterations: Flow-matching iterations of the expert, or positions of action tokens, that take part.
        notes: Remarks for the reader, a sentence each: which runs have no probes, and which settings the rows mix.
        wordings: Of runs that were asked in several wordings, every two against each other.
        vlm_vla: VLM − VLA, if that was requested.
        unpaired: Which runs of several have no difference, or leave items out, and why, a sentence each.
        runs: The runs in the form that the rows read, VLM runs first.
    """

    rows: list[RetentionRow]
    means: list[RetentionRow]
    differences: list[Difference] = field(default_factory=list)
    results: Mapping[tuple[str, str], ProbeResults] = field(default_factory=dict, repr=False)
    iterations: Iterations = "all"
    notes: tuple[str, ...] = ()
    wordings: list[Difference] = field(default_factory=list)
    vlm_vla: list[Difference] = field(default_factory=list)
    unpaired: tuple[str, ...] = ()
    runs: tuple[TableRun, ...] = field(default=(), repr=False, compare=False)

    def __repr__(self) -> str:
        categories = len({row.category for row in self.rows})
        models = ", ".join(dict.fromkeys(map(model_name, self.rows))) or "no runs"
        return f"<RetentionTable of {models}: {categories} categories; print(table.to_markdown()) shows it>"

    def _repr_html_(self) -> str:
        """Return the summary with its sentences, and the tables folded below it.

        Pointing at a heading explains it.
        """
        from markupsafe import Markup

        rows = [category for run in self.summary for category in run.categories]
        item = Markup("<li><b>{}</b> {}</li>")
        sentences = Markup("").join(
            item.format(category.name, without_folders(category.finding)) for category in rows
        )
        tables = [table for title, table in self.tables().items() if title != "Controls"]
        pages = "".join(part._repr_html_() for table in tables if (part := table.details(False)) is not None)
        details = f"<details><summary>All tables</summary>{pages}</details>"
        return f"{self.summary_table._repr_html_()}<ul>{sentences}</ul>{details}"

    @property
    def targets(self) -> tuple[str, ...]:
        """The targets of the rows, in order."""
        return tuple(dict.fromkeys(row.target for row in self.rows))

    @property
    def labels(self) -> tuple[str, ...]:
        """The labels of the rows, in order; empty where all are of the answer's side: success rates and a mean."""
        return tuple(dict.fromkeys(row.label for row in self.rows if row.label))

    def results_of(self, location: Location | str) -> ProbeResults | None:
        """Return the probes of a run, of its first target; None without any."""
        return next((results for (of_run, _), results in self.results.items() if of_run == str(location)), None)

    def runs_of(self, runs: Sequence[RunReader]) -> list[TableRun]:
        """Return runs in the form that the table reads, in order.

        Raises:
            UsageError: For a run that the table has no rows of.
        """
        with_rows = {row.run.location for row in self.rows}
        read = {run.location: run for run in self.runs if run.location in with_rows}
        if strangers := [str(run.location) for run in runs if str(run.location) not in read]:
            raise UsageError(
                f"the table has no rows of {', '.join(strangers)}; make it of the runs that are drawn"
            )
        return [read[str(run.location)] for run in runs]

    def of_target(self, target: str) -> Self:
        """Return the table of one target; p stays as it is."""
        results = {name: probes for name, probes in self.results.items() if name[1] == target}
        return replace(self, rows=[row for row in self.rows if row.target == target], results=results, notes=())

    @property
    def rule(self) -> str:
        """The outcome rule by which episodes were judged; answers of VLM runs have none."""
        return next((row.rules.rule for row in self.rows if row.run.mode == "acts"), DEFAULT_RULE)

    @property
    def last_steps(self) -> int:
        """The number of control steps at the end that it judged."""
        return next((row.rules.last_steps for row in self.rows if row.run.mode == "acts"), 1)

    @property
    def all_rows(self) -> list[RetentionRow]:
        """Category rows of each run and view, each followed by its mean where there is one."""
        if not self.means:
            return list(self.rows)
        return [
            row
            for mean in self.means
            for row in [
                *(r for r in self.rows if (*r.key, r.view) == (*mean.key, mean.view)),
                mean,
            ]
        ]

    @property
    def success(self) -> "pd.DataFrame":
        """Success rates by `run` and `category`, with the fields of `SuccessRate`."""
        return part_frame(self.all_rows, "success", by_view=False)

    @property
    def rules(self) -> "pd.DataFrame":
        """The success that the rule grants without skill, by `run` and `category`, as `OutcomeRuleScores`."""
        return part_frame(self.all_rows, "rules", by_view=False)

    @property
    def answers(self) -> "pd.DataFrame":
        """The answers of VLM runs by `run` and `category`, with the fields of `AnswerStats`."""
        return part_frame([row for row in self.all_rows if row.run.mode == "answers"], "answers", by_view=False)

    @property
    def probes(self) -> "pd.DataFrame":
        """The best sites by `run`, `category`, `view` and `stream`, with the fields of `ActionPart`."""
        return peak_frame(self.all_rows)

    @property
    def retention(self) -> "pd.DataFrame":
        """Retention by `run`, `category` and `view`, with the fields of `RetentionPart`."""
        return part_frame(self.all_rows, "retention")

    @property
    def controls(self) -> "pd.DataFrame":
        """The controls of probes by `run`, `category` and `view`, with the fields of `ControlScores`."""
        return part_frame(self.all_rows, "controls")

    @property
    def interventions(self) -> "pd.DataFrame":
        """Effects of stored image swaps by `run`, `category` and `view`, with the fields of `SwapEffect`."""
        return part_frame([row for row in self.all_rows if row.image_swap.follow_rate is not None], "image_swap")

    def to_frame(self) -> "pd.DataFrame":
        """Return all rows as one data frame: the fields of `RetentionRow`, those of its parts as `part.field`.

        Shares, ratios and limits are floats, NaN where they are not defined: retention without backbone signal
        too, whose raw ratio `to_json` keeps. Intervals become two columns, `success.ci_low` and so on. Mappings
        become one column per name, such as `controls.baselines.pixels`, and lists become text. The frames
        `success`, `rules`, `answers`, `probes`, `retention`, `controls` and `interventions` hold one part each.
        """
        return frame_of(self.all_rows)

    def differences_frame(self) -> "pd.DataFrame":
        """Return the differences as a data frame with the fields of `Difference`, intervals as two columns."""
        return frame_of(self.differences)

    def to_json(self) -> str:
        """Return all rows as a JSON list of objects, whose keys are the fields of `RetentionRow`.

        Parts are objects in them. Where runs are compared, every row has a list `differences` as well: those of
        its run minus others. With groups, runs in several wordings or VLM − VLA, the result is an object. It has
        the lists `rows`, `differences` between groups, `wordings` and `vlm_vla`, as far as there are any.
        """
        return table_json(self.all_rows, self.differences, self.wordings, self.vlm_vla)

    def to_csv(self) -> str:
        """Return all rows as comma-separated values with a header; differences have `differences_frame`.

        A text that a spreadsheet would compute has a `'` in front.
        """
        return csv_of_frame(self.to_frame())

    def to_text(self, style: str, details: Collection[Section] | Literal["all"] = ()) -> str:
        """Return the summary, a sentence per category and the tables of some sections in a format of text.

        Args:
            style: Name of the format, such as `markdown`.
            details: Sections whose tables follow the summary, as of `to_rich`; all of them by "all".
        """
        sentences = [f"{category.name}  {category.finding}" for run in self.summary for category in run.categories]
        return render(style, [self.summary_table, *self._details(details)], sentences, self.notes)

    def to_markdown(self) -> str:
        """Return success rates, retention, controls and differences as Markdown tables, with all columns."""
        rows = [category for run in self.summary for category in run.categories]
        sentences = [
            *(f"{category.name}  {category.finding}" for category in rows),
            *(category.details for category in rows),
        ]
        tables = [self.summary_table, *self.tables().values(), *self.wording_tables, *self.further_tables]
        return render("markdown", tables, sentences, self.notes)

    def to_latex(self, details: Collection[Section] | Literal["all"] = ()) -> str:
        """Return the summary in LaTeX with booktabs rules, each table with a caption, a label and a line's width.

        Args:
            details: Sections whose tables follow it, as of `to_rich`; all of them by "all".
        """
        tables = [self.summary_table, *self._details(details)]
        return render("latex", tables, notes=(*self.unpaired, *self.notes))

    def tables(self, sections: Collection[Section] | None = None) -> dict[str, Table]:
        """Return answers, success, retention and controls by title.

        Args:
            sections: Sections whose columns are shown; None for all.
        """
        return retention_tables(self.all_rows, self.differences, self.unpaired, sections)

    @property
    def wording_tables(self) -> list[Table]:
        """The wordings of each run against each other, a table per run."""
        return wording_tables(self.wordings, {row.run.location: row.run.label for row in self.rows})

    @property
    def summary_table(self) -> Table:
        """A row per category and run, and below them the differences of runs."""
        return summary_table(self.summary, self.differences)

    def _details(self, details: Collection[Section] | Literal["all"]) -> list[Table]:
        """Return the tables of some sections, without columns that need room."""
        sections: Collection[Section] = get_args(Section) if details == "all" else details
        narrow = (table.details(False) for table in self.tables(sections).values())
        wordings = self.wording_tables if "success" in sections else []
        further_tables = self.further_tables if "answers" in sections else vlm_vla_tables(self.vlm_vla)
        return [*(table for table in narrow if table is not None), *wordings, *further_tables]

    @property
    def summary(self) -> list[RunSummary]:
        """The findings of the table: per run, a row and a sentence for every category."""
        return summarise_runs(self.all_rows)

    @property
    def as_paper(self) -> Table:
        """The paper's own numbers by its own formulas, see `probe_kit.retention.formats`."""
        steps = f" over the last {self.last_steps} control steps" if self.last_steps > 1 else ""
        return paper_table(self.rows, self.means, f"outcome rule {self.rule}{steps}")

    def __rich__(self) -> "Group":
        return self.to_rich()

    def to_rich(self, details: Collection[Section] | Literal["all"] = (), with_next_step: bool = True) -> "Group":
        """Return the summary for a rich console: one table, a sentence per category, and the next step.

        Args:
            details: Sections that are shown above it, see `probe_kit.retention.choices.Section`; all of them by
                "all".
            with_next_step: Whether a line with the next step is added.
        """
        from rich.console import Group
        from rich.text import Text

        summary = self.summary
        why = self.unpaired if details or len(summary) > 1 else ()
        notes = [Text(sentence, style="yellow") for sentence in (*why, *self.notes)]
        long = [Text(category.details) for run in summary for category in run.categories] if details else []
        short: list[Text] = []
        for run in summary:
            short += [Text(run.title, style="bold")] * (len(summary) > 1) + [*map(Text, run.sentences)]
        last = Text(next_step(self.rows), style="bold") if with_next_step else Text("")
        return Group(
            *self._details(details), *long, self.summary_table, *notes, *short, *[last] * bool(last.plain)
        )

    @property
    def further_tables(self) -> list[Table]:
        """Sizes of the picture by prompt, and VLM − VLA, as far as there are VLM runs."""
        return [*size_table(self.means), *vlm_vla_tables(self.vlm_vla)]


def retention_table(
    runs: Sequence[RunReader] | Mapping[str, Sequence[RunReader]],
    views: Sequence[str] | None = None,
    *,
    target: str | Sequence[str] | None = None,
    family: Family = "label",
    iterations: Iterations = "all",
    keys: Sequence[str | None] | None = None,
    epsilons: Sequence[float] = SENSITIVITY_RADII,
    score: str = "text",
    with_side_words: bool = False,
    vlm_vla: bool | Sequence[tuple[str, str]] = False,
    rule: str = DEFAULT_RULE,
    last_steps: int = 1,
    absent_below: float = ABSENT_BELOW,
    against: str | None = None,
    labels: Mapping[str, str] | None = None,
    pairs: Sequence[tuple[str, str]] | None = None,
    origins: Mapping[str, str] | None = None,
    categories: Sequence[str] | None = None,
    with_behaviour: bool = True,
) -> RetentionTable:
    """Return success rates, best sites of probes and retention of several runs, per category and view.

    A run that keeps no trajectories has no success rate by another rule than `disc`. A run without activations or
    probes shows success rates only.

    Args:
        runs: A list, of which the first is compared with every other on the same questions (see `compare_runs`),
            or lists by the name of a group, such as `{"vqa": [a], "no vqa": [b, c]}`; groups are compared with
            each other.
        views: Views of the probes; None for all that were probed.
        target: A column of labels, or several, whose retention is shown instead of that of a side. Then only runs,
            views, iterations, keys, family and labels count. None for sides of a picture.
        family: `table` corrects p for all targets by Holm's method, per run, category, view and stream.
        iterations: Expert iterations that take part.
        keys: Keys of the stored probe results of each run, in order; None for the newest, "" for none.
        epsilons: Zone radii in metres at which SR is scored again, for the rule `disc`.
        score: The score by which VLM runs are read, `text`, `logits` or `order-balanced`; they come first.
        with_side_words: Whether items of VLM runs in whose name a side stands are counted.
        vlm_vla: Whether every VLM run is compared with every acting one, see `compare_with_vlms`; or pairs of
            these by their locations.
        rule: The rule by which episodes are judged, a name of `probe_kit.env.scoring.RULES`.
        last_steps: Number of control steps at the end of an episode that count.
        absent_below: Accuracy below which a stream without signal is called absent.
        against: The name of the run or group that every other is compared with; None for the default.
        labels: Names of runs in tables and figures by their location, instead of their own.
        pairs: Pairs of locations of runs that are compared, each the first minus the second, instead of every
            other with the first; all of them are one family of tests.
        origins: Of groups, the origins of the models by the location of their runs; models of one origin count as
            one. By default checkpoints of one training do.
        categories: Categories that have rows and are averaged; None for all. Probes are those of the whole runs.
        with_behaviour: False leaves empty the parts that the rule `disc` does not need (other rules and
            behaviour), so that no trajectory is read.

    Raises:
        UnknownSiteError: For a view that was not probed.
        UsageError: For an unknown key or a number of keys that is not that of the runs, for a run that is given
            twice, for `against` or `pairs` where they are none of the runs, for a side as target, and for labels
            that differ between runs.
        NoProbesError: For a run without probes of a target.
        SceneError: For overlapping zones.
    """
    targets = [target] if isinstance(target, str) else target
    if targets is not None and (isinstance(runs, Mapping) or against or pairs or vlm_vla):
        raise UsageError("labels are not compared between runs or groups; give runs alone, or no target")
    groups = runs if isinstance(runs, Mapping) else {None: runs}
    members = [(group, run) for group, of_group in groups.items() for run in of_group]
    key_of_run = _key_of_run(keys, len(members))
    if targets is None:
        # The default itself, and not radii equal to it, means that the caller named none.
        check_epsilons(check_rule(rule), epsilons is not SENSITIVITY_RADII)
        members, key_of_run = _side_members(members, key_of_run, score, with_side_words)
    every = [run for _, run in members]
    names = distinct_labels(every, labels)
    # Rows of labels show no success rate, so that no rule judges them and no trajectory is read.
    judging = (rule, last_steps, with_behaviour) if targets is None else (DEFAULT_RULE, 1, False)
    table_runs = [
        TableRun.of(run, *judging, label=names[str(run.location)], group=group) for group, run in members
    ]
    if targets is None:
        probes_of_rows, notes = _read_sides(table_runs, key_of_run)
    else:
        probes_of_rows, notes = _read_labels(table_runs, targets, key_of_run), []
    settings = RowSettings(views, iterations, epsilons, absent_below, categories)
    rows_of_runs = [run_rows(table_run, probes, settings) for table_run, probes in probes_of_rows]
    estimated = [row for of_run in rows_of_runs for row in of_run]
    rows = [row.row for row in estimated]
    results = {
        (run.location, probes.settings.target): replace(
            probes, label=(labels or {}).get(run.location, probes.label)
        )
        for run, probes in probes_of_rows
        if probes is not None
    }
    if targets is not None:
        rows = with_holm_of_targets(rows, results) if family == "table" else rows
        notes += [*_label_notes(table_runs, rows, family), *mixed_episodes(every), *_success_notes(table_runs)]
        notes += without_content(every)
        return RetentionTable(
            rows, [], results=results, iterations=iterations, notes=tuple(notes), runs=tuple(table_runs)
        )
    unjudged = [
        f"{run.location} keeps no trajectories, so that its success rate by the rule {rule} is n/a. Extract it "
        "again to have it."
        for run in table_runs
        if not run.is_judged and not run.is_captured_only
    ]
    if unjudged and isinstance(runs, Mapping):
        raise NoTrajectoryError(f"groups cannot be compared by the rule {rule}: {unjudged[0]}")
    differences, unpaired = list[Difference](), tuple[str, ...]()
    if isinstance(runs, Mapping):
        by_group = {name: [run for run in table_runs if run.group == name] for name in runs}
        differences, unpaired = compare_groups(by_group, estimated, against, origins)
    elif len(every) > 1 or against is not None:
        differences, unpaired = compare_runs(table_runs, estimated, against, bool(vlm_vla), pairs)
    vlm_differences: list[Difference] = []
    if vlm_vla is not False:
        vlm_pairs = None if isinstance(vlm_vla, bool) else vlm_vla
        vlm_differences = compare_with_vlms(table_runs, estimated, vlm_pairs)
    if vlm_vla is True and not vlm_differences:
        raise UsageError(
            "--kind vlm-vla compares VLM runs with policy runs in the same categories, and these runs have no "
            "such pair. Make the missing ones with `probe-kit ask` or `probe-kit extract`"
        )
    captured_only = [
        f"{run.location} captured activations only and did not act: SR is n/a."
        for run in table_runs
        if run.is_captured_only
    ]
    notes += [*unjudged, *captured_only, *mixed_settings(results, views)]
    notes += [*mixed_episodes(every), *chosen_wordings(every), *left_out(every), *without_content(every)]
    return RetentionTable(
        rows,
        [mean for of_run in rows_of_runs for mean in _means(of_run)],
        differences,
        results,
        iterations,
        tuple(notes),
        compare_wordings([run.judged for run in table_runs if run.is_judged]),
        vlm_differences,
        unpaired,
        tuple(table_runs),
    )


Member = tuple[str | None, RunReader]
"""A run of a group, and the name of the group where there are several."""


def _side_members(
    members: Sequence[Member], keys: Sequence[str | None], score: str, with_side_words: bool
) -> tuple[list[Member], list[str | None]]:
    """Return runs, read by a score, and their keys, those of VLM runs first.

    Args:
        members: Runs with the name of their group.
        keys: Key of each run's probe results.
        score: The score by which VLM runs are read.
        with_side_words: Whether items of VLM runs in whose name a side stands are counted.

    Raises:
        UsageError: For a run without sides, or one that is given twice.
    """
    for _, run in members:
        check_sides(run, "a retention table")
    _check_doubles([run for _, run in members])
    order = sorted(range(len(members)), key=lambda at: members[at][1].ask is None)
    read = [(group, scored(run, score, with_side_words)) for group, run in members]
    return [read[at] for at in order], [keys[at] for at in order]


def _means(of_run: Sequence[RowWithEstimates]) -> list[RetentionRow]:
    """Return the mean over the categories of a run in each view."""
    views = dict.fromkeys(row.row.view for row in of_run)
    return [mean_row([row for row in of_run if row.row.view == view], averaged_fields()) for view in views]


def _key_of_run(keys: Sequence[str | None] | None, runs: int) -> list[str | None]:
    if keys is not None and len(keys) != runs:
        raise UsageError(f"{len(keys)} keys for {runs} runs; give one per run, or None for the newest")
    return list(keys or [None] * runs)


def _check_doubles(runs: Sequence[RunReader]) -> None:
    """Raise UsageError for a run that is given twice; a copy of its folder is the same run.

    A run that counts twice makes every interval too narrow.
    """
    location_of: dict[str, str] = {}
    for run in runs:
        stamp = run.stamp
        for name in (run.location.address, *([f"{run.settings_sha256} {stamp}"] if stamp else [])):
            if name in location_of:
                other = "" if location_of[name] == str(run.location) else f", once as its copy {location_of[name]}"
                raise UsageError(
                    f"{run.location} is given twice{other}; its episodes would count twice. Leave one out"
                )
            location_of[name] = str(run.location)


ProbesOfRows = list[tuple[TableRun, ProbeResults | None]]
"""The runs in the order of their rows, target by target, with the probes that these are made of."""


def _read_sides(runs: Sequence[TableRun], keys: Sequence[str | None]) -> tuple[ProbesOfRows, list[str]]:
    """Return the probes of sides, and a sentence for every run without, except for models that were only asked."""
    probes_of_rows: ProbesOfRows = []
    notes = []
    for table_run, key in zip(runs, keys, strict=True):
        run, probes = table_run.run, None
        if key == "":
            if run.streams:
                notes.append(f"Success rates only: no probes of {run.location} belong to this table.")
        else:
            try:
                probes = load_side_results(run, key)
            except NoProbesError as error:
                if run.streams or not table_run.answers:
                    shares = "Answers" if table_run.answers else "Success rates"
                    notes.append(f"{shares} only: {error}")
        if probes is not None and not is_current(probes.settings, run):
            notes.append(
                f"The probes {probes.key} of {run.location} are of other episodes than the run has now: "
                "accuracies and success rates do not belong together. "
                f"`probe-kit train {as_argument(run.location)}` fits new ones."
            )
        probes_of_rows.append((table_run, probes))
    return probes_of_rows, notes


def _read_labels(runs: Sequence[TableRun], targets: Sequence[str], keys: Sequence[str | None]) -> ProbesOfRows:
    """Return the stored probes of every target in every run.

    Args:
        runs: Runs of the table.
        targets: Label columns in order.
        keys: Key of each run's probe results, the newest by default; with one target only.

    Raises:
        NoProbesError: For a run without probes of a target.
        UsageError: For a side, a target given twice, a key of another target, and several runs whose labels
            differ.
    """
    if not runs or not targets:
        raise UsageError("retention of a label needs at least one run and one target")
    if sides := [name for name in targets if name in SIDES]:
        raise UsageError(
            f"the target {sides[0]!r} is the name of a side. Leave --target out for the retention of sides"
        )
    if doubles := [name for at, name in enumerate(targets) if name in targets[:at]]:
        raise UsageError(f"the target {doubles[0]!r} is given twice; leave one out")
    if len(targets) > 1 and any(keys):
        raise UsageError(
            f"stored probes are chosen by key for {len(targets)} targets ({', '.join(targets)}); a key is of one. "
            "Show one target at a time, or leave the keys out"
        )
    probes_of_rows: ProbesOfRows = []
    for target in targets:
        of_target = [load_results(run.run, key, target) for run, key in zip(runs, keys, strict=True)]
        for table_run, probes in zip(runs, of_target, strict=True):
            if probes.settings.label != of_target[0].settings.label:
                raise UsageError(
                    f"the labels {target!r} of {table_run.location} and {runs[0].location} differ (sha256 "
                    f"{probes.settings.label[:12]} and {of_target[0].settings.label[:12]}); retention is compared "
                    "on the same labels of the same episodes. Show the runs one by one"
                )
            probes_of_rows.append((table_run, probes))
    return probes_of_rows


_NAMED = 8
"""Largest number of labels of a run that a sentence names."""


def _label_notes(runs: Sequence[TableRun], rows: Sequence[RetentionRow], family: Family) -> Iterator[str]:
    """Yield a warning where a signal was compared with no control, and how many labels were tried in each run."""
    bare = [row for row in rows if row.backbone.peak is not None and not row.backbone.is_controlled]
    if bare:
        of_runs = ", ".join(dict.fromkeys(f"{row.target} of {row.run.name}" for row in bare))
        yield f"No control was run for {of_runs}: a signal there is judged against chance only."
    count = len({row.target for row in rows})
    corrected = (
        "of each label alone" if family == "label" else f"corrected for the {count} labels of this table (Holm)"
    )
    for table_run in runs:
        tried = stored_targets(table_run.run)
        if sum(tried.values()) > 1:
            yield f"{table_run.name} has probes of {_in_words(tried)}; p is {corrected}."


def _success_notes(runs: Sequence[TableRun]) -> Iterator[str]:
    """Yield the success rates of runs in environments, which have no rows of their own."""
    for table_run in runs:
        if (success := EnvironmentSuccess.of(table_run.run.episodes)) is not None:
            yield f"{table_run.name}: {success.sentence}."
            yield from _condition_notes(table_run)
        if (reason := why_no_rates(table_run.run.episodes)) is not None:
            yield f"{table_run.name}: {reason}."


def _condition_notes(table_run: TableRun) -> Iterator[str]:
    """Yield a test per condition of a policy server against `none`: success is dealt anew within each group.

    That is how conditions were drawn, so that the test needs no assumption about episodes or groups.
    """
    episodes = table_run.run.episodes
    rated = episodes.dropna(subset=[AT_END])
    if CONDITION not in rated:
        return
    names = [name for name in sorted(rated[CONDITION].unique()) if name != UNEDITED]
    both = [rated[rated[CONDITION].isin([name, UNEDITED])] for name in names]
    p_values = holm(
        [
            overlap_p(
                part[AT_END].to_numpy(bool), (part[CONDITION] == name).to_numpy(), part["group_id"], _DEALS_SEED
            )
            if part[CONDITION].nunique() == 2
            else None
            for name, part in zip(names, both, strict=True)
        ]
    )
    for name, p in zip(names, p_values, strict=True):
        if p is not None:
            corrected = f", corrected for {len(names)} conditions (Holm)" if len(names) > 1 else ""
            yield (
                f"{table_run.name}: condition {name} against {UNEDITED}: p {p:.3f}{corrected}; conditions are "
                "dealt anew within each group."
            )


_DEALS_SEED = 0
"""The seed of the draws of `overlap_p`, so that a table repeats."""


def _in_words(tried: Mapping[str, int]) -> str:
    """Return how many labels a run has probes of; one whose values changed counts again."""
    words = [f"{name} in {of} versions" if of > 1 else name for name, of in tried.items()]
    first = ", ".join([*words[:_NAMED], *["…"] * (len(words) > _NAMED)])
    return f"{plural(sum(tried.values()), 'label')} ({first})"
