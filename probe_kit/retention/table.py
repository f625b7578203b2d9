"""The retention table: several runs joined, and the ways to write it down."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, Self, get_args

from probe_kit._system.escaping import csv_of_frame, without_places
from probe_kit._tables.formats import render
from probe_kit._tables.table import Table
from probe_kit.env.scoring import DEFAULT_RULE, SENSITIVITY_RADII, check_rule
from probe_kit.errors import NoProbesError, NoTrajectoryError, UsageError
from probe_kit.retention.behaviour import (
    ask_of,
    capture_only,
    chosen_wordings,
    distinct_labels,
    left_out,
    mixed_episodes,
    mixed_settings,
    scored,
)
from probe_kit.retention.choices import Family, Iterations, Section
from probe_kit.retention.columns.columns import averaged_fields
from probe_kit.retention.columns.comparisons import size_table, vlm_vla_tables, wording_tables
from probe_kit.retention.columns.summary import RunSummary, next_step, summarise_runs, summary_table
from probe_kit.retention.columns.tables import retention_tables
from probe_kit.retention.columns.text import model_name
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.compare.pairing import (
    compare_groups,
    compare_runs,
    compare_with_vlms,
    compare_wordings,
)
from probe_kit.retention.formats import frame_of, paper_table, part_frame, peak_frame, table_json
from probe_kit.retention.rows.build import RowSettings, RowWithEstimates, mean_row, run_rows
from probe_kit.retention.rows.outcome_rules import can_be_judged, check_epsilons, under_rule
from probe_kit.retention.rows.probe_parts import label_notes, label_rows, read_labels
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.runs.reader import RunReader, check_sides
from probe_kit.runs.store import Location
from probe_kit.statistics.sufficiency import ABSENT_BELOW
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import is_current, load_side_results

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Group


@dataclass(frozen=True, repr=False)
class RetentionTable:
    """Rows per run, category and view, and per run and view their category mean.

    Runs are never averaged with each other, so no mean mixes suites. differences: between runs, or groups of runs.
    unpaired: which runs of several have none, or leave items out, and why, a sentence each.
    results: the probes that the rows were made of, by location of the run and target; figures and reports of the
    table draw these. Rows of targets that are no side have no mean, as their metrics differ.
    wordings: of runs that were asked in several, every two against each other.
    iterations: of the expert, or action tokens, that take part. notes: what a reader must know, a sentence each:
    which runs have no probes, and which settings the rows mix. vlm_vla: VLM − VLA, if that was requested.
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

    def __repr__(self) -> str:
        categories = len({row.category for row in self.rows})
        models = ", ".join(dict.fromkeys(map(model_name, self.rows))) or "no runs"
        return f"<RetentionTable of {models}: {categories} categories; print(table.to_markdown()) shows it>"

    def _repr_html_(self) -> str:
        """The summary with its sentences, and folded below it the tables; pointing at a heading explains it."""
        from markupsafe import Markup

        rows = [category for run in self.summary for category in run.categories]
        item = Markup("<li><b>{}</b> {}</li>")
        sentences = Markup("").join(
            item.format(category.name, without_places(category.finding)) for category in rows
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
    def is_of_sides(self) -> bool:
        """Whether the rows are of sides of a picture, which have success rates and a mean."""
        return all(row.is_side for row in self.rows)

    def results_of(self, location: Location | str) -> ProbeResults | None:
        """Return the probes of a run, of its first target; None without any."""
        return next((results for (of_run, _), results in self.results.items() if of_run == str(location)), None)

    def of_target(self, target: str) -> Self:
        """Return the table of one target; p stays as it is."""
        results = {name: probes for name, probes in self.results.items() if name[1] == target}
        return replace(self, rows=[row for row in self.rows if row.target == target], results=results, notes=())

    @property
    def rule(self) -> str:
        """The outcome rule by which episodes were judged."""
        return self.rows[0].rules.rule if self.rows else DEFAULT_RULE

    @property
    def last_steps(self) -> int:
        """The number of control steps at the end that it judged."""
        return self.rows[0].rules.last_steps if self.rows else 1

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
        """Return what the rule gives away, by `run` and `category`, with the fields of `OutcomeRuleScores`."""
        return part_frame(self.all_rows, "rules", by_view=False)

    @property
    def answers(self) -> "pd.DataFrame":
        """Return the answers of VLM runs by `run` and `category`, with the fields of `AnswerStats`."""
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
        """Return the controls of probes by `run`, `category` and `view`, with the fields of `ControlScores`."""
        return part_frame(self.all_rows, "controls")

    @property
    def interventions(self) -> "pd.DataFrame":
        """Effects of stored image swaps by `run`, `category` and `view`, with the fields of `SwapEffect`."""
        return part_frame([row for row in self.all_rows if row.image_swap.follow_rate is not None], "image_swap")

    def to_frame(self) -> "pd.DataFrame":
        """All rows as one data frame: the fields of `RetentionRow`, those of its parts as `part.field`.

        Shares, ratios and limits are floats, NaN where they are not defined: retention without backbone signal
        too, whose raw ratio `to_json` keeps. Intervals become two columns, `success.ci_low` and so on, what is
        kept by name one column per name, such as `controls.baselines.pixels`, and lists become text. The frames
        `success`, `rules`, `answers`, `probes`, `retention`, `controls` and `interventions` hold one part each.
        """
        return frame_of(self.all_rows)

    def differences_frame(self) -> "pd.DataFrame":
        """Differences as a data frame with the fields of `Difference`, intervals as two columns."""
        return frame_of(self.differences)

    def to_json(self) -> str:
        """All rows as a JSON list of objects; the keys are the fields of `RetentionRow`,
        which hold objects for its parts.

        Where runs are compared, every row has a list `differences` as well: those of its run minus others. With
        groups, runs in several wordings or VLM − VLA, an object with the lists `rows`, `differences` between
        groups, `wordings` and `vlm_vla`, as far as there are any.
        """
        return table_json(self.all_rows, self.differences, self.wordings, self.vlm_vla)

    def to_csv(self) -> str:
        """All rows as comma-separated values with a header; differences have `differences_frame`.

        A text that a spreadsheet would compute has a `'` in front.
        """
        return csv_of_frame(self.to_frame())

    def to_text(self, style: str, details: Collection[Section] | Literal["all"] = ()) -> str:
        """Return the summary, a sentence per category and the tables of some sections in a format of text.

        details: as of `to_rich`.
        """
        sentences = [f"{category.name}  {category.finding}" for run in self.summary for category in run.categories]
        return render(style, [self.summary_table, *self._details(details)], sentences, self.notes)

    def to_markdown(self) -> str:
        """Success rates, retention, controls and differences as Markdown tables, with all columns."""
        rows = [category for run in self.summary for category in run.categories]
        sentences = [
            *(f"{category.name}  {category.finding}" for category in rows),
            *(category.details for category in rows),
        ]
        tables = [self.summary_table, *self.tables().values(), *self.wording_tables, *self.further_tables]
        return render("markdown", tables, sentences, self.notes)

    def to_latex(self, details: Collection[Section] | Literal["all"] = ()) -> str:
        """Return the summary in LaTeX with booktabs rules, each table with a caption, a label and a line's width.

        details: sections whose tables stand below it, as of `to_rich`; all of them by "all".
        """
        tables = [self.summary_table, *self._details(details)]
        return render("latex", tables, notes=(*self.unpaired, *self.notes))

    def tables(self, sections: Collection[Section] | None = None) -> dict[str, Table]:
        """Return answers, success, retention and controls by title. sections: those shown, all by default."""
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
        """The tables of some sections, without columns that need room."""
        sections: Collection[Section] = get_args(Section) if details == "all" else details
        narrow = (table.details(False) for table in self.tables(sections).values())
        wordings = self.wording_tables if "success" in sections else []
        further_tables = self.further_tables if "answers" in sections else vlm_vla_tables(self.vlm_vla)
        return [*(table for table in narrow if table is not None), *wordings, *further_tables]

    @property
    def summary(self) -> list[RunSummary]:
        """Per run a row and a sentence for every category: what the table found."""
        return summarise_runs(self.all_rows)

    @property
    def as_paper(self) -> Table:
        """The paper's own numbers by its own formulas, see `probe_kit.retention.formats`."""
        steps = f" over the last {self.last_steps} control steps" if self.last_steps > 1 else ""
        return paper_table(self.rows, self.means, f"outcome rule {self.rule}{steps}")

    def __rich__(self) -> "Group":
        return self.to_rich()

    def to_rich(self, details: Collection[Section] | Literal["all"] = (), with_next_step: bool = True) -> "Group":
        """The summary for a rich console: one table, a sentence per category, and one line what to do next.

        details: sections that are shown above it, see `probe_kit.retention.choices.Section`; all of them by "all".
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

    runs: a list, of which the first is compared with every other on the same questions (see `compare_runs`), or
    lists by the name of a group, such as `{"vqa": [a], "no vqa": [b, c]}`; groups are compared with each other.
    against: the run or group that every other is compared with instead, by its name. views: those that were probed
    by default. iterations: which expert iterations take part. keys: which stored probe results of each run to use,
    in order, the newest by default, and none for "". epsilons: zone radii in metres at which SR is scored again,
    for the rule `disc`. rule: by which episodes are judged, a name of `probe_kit.env.scoring.RULES`;
    last_steps: control steps at their end that count. absent_below: accuracy below which a stream without signal
    is called absent. A run that keeps no trajectories has no success rate by another rule than `disc`. A run
    without activations or probes shows success rates only. score: by which VLM runs are read, `text`, `logits` or
    `order-balanced`; they stand first. with_side_words: count their items in whose name a side stands. vlm_vla:
    compare every VLM run with every acting one, see `compare_with_vlms`, or pairs of these by their locations.
    labels: names of runs in tables and figures by their location, instead of their own. pairs: by location, the
    runs that are compared, each the first minus the second, instead of every other with the first; all of them are
    one family of tests. origins: of groups, what the models grew from by the location of their runs; models of one
    origin count as one. By default checkpoints of one training do. categories: rows of these alone, and means over
    them; probes are those of the
    whole runs. with_behaviour: False leaves empty what the rule `disc` does not need (other rules and behaviour),
    so that no trajectory is read. target: columns of labels, whose retention it is instead of that of a side; of
    these runs, views, iterations, keys, family and labels alone count. family: `table` corrects p for all targets
    by Holm's method, per run, category, view and stream. Raises UnknownSiteError for a view that was not probed,
    UsageError for an unknown key or a number of keys that is not that of the runs, for a run that is given twice,
    for `against` or `pairs` where they are none of the runs, for a side as target, and for labels that differ
    between runs; NoProbesError for a run without probes of a target; SceneError for overlapping zones.
    """
    if target is not None:
        if isinstance(runs, Mapping) or against or pairs or vlm_vla:
            raise UsageError("labels are not compared between runs or groups; give runs alone, or no target")
        return _label_table(
            runs, [target] if isinstance(target, str) else target, views, iterations, keys, family, labels
        )
    # The default itself, and not radii equal to it, means that the caller named none.
    check_epsilons(check_rule(rule), epsilons is not SENSITIVITY_RADII)
    groups = runs if isinstance(runs, Mapping) else {None: runs}
    for run in (run for of_group in groups.values() for run in of_group):
        check_sides(run, "a retention table")
    listed = [(name, scored(run, score, with_side_words)) for name, of_group in groups.items() for run in of_group]
    key_of_run = _key_of_run(keys, len(listed))
    _check_doubles([run for _, run in listed])
    order = sorted(range(len(listed)), key=lambda at: ask_of(listed[at][1]) is None)
    listed, key_of_run = [listed[at] for at in order], [key_of_run[at] for at in order]
    every = [run for _, run in listed]
    results, notes = _read_probes(every, key_of_run)
    unscored = [
        f"{run.location} keeps no trajectories, so that its success rate by the rule {rule} is n/a. Extract it "
        "again to have it."
        for run in every
        if not can_be_judged(run, rule, last_steps)
    ]
    if unscored and isinstance(runs, Mapping):
        raise NoTrajectoryError(f"groups cannot be compared by the rule {rule}: {unscored[0]}")
    settings = RowSettings(views, iterations, epsilons, rule, last_steps, absent_below, categories, with_behaviour)
    drawn: list[RowWithEstimates] = []
    means: list[RetentionRow] = []
    for name, run in listed:
        of_run = run_rows(run, results.get(str(run.location)), settings, name)
        drawn += of_run
        views_of = dict.fromkeys(row.row.view for row in of_run)
        in_views = [[row for row in of_run if row.row.view == view] for view in views_of]
        means += [mean_row(rows, averaged_fields()) for rows in in_views]
    names = distinct_labels(every, labels)
    results = {
        location: replace(probes, label=(labels or {}).get(location, probes.label))
        for location, probes in results.items()
    }
    differences, unpaired = list[Difference](), tuple[str, ...]()
    if isinstance(runs, Mapping):
        by_group = {name: [run for group, run in listed if group == name] for name in runs}
        differences, unpaired = compare_groups(by_group, drawn, against, origins)
    elif len(every) > 1 or against is not None:
        differences, unpaired = compare_runs(every, drawn, names, against, bool(vlm_vla), pairs)
    unmoving = [run for run in every if capture_only(run.episodes)]
    notes += [
        *unscored,
        *(f"{run.location} captured activations only and did not act: SR is n/a." for run in unmoving),
        *mixed_settings(results, views),
        *mixed_episodes(every),
        *chosen_wordings(every),
        *left_out(every),
    ]
    judged = [under_rule(run, rule, last_steps) for run in every if can_be_judged(run, rule, last_steps)]
    gaps: list[Difference] = []
    if vlm_vla is not False:
        gaps = compare_with_vlms(every, drawn, names, None if isinstance(vlm_vla, bool) else vlm_vla)
    if vlm_vla is True and not gaps:
        raise UsageError(
            "--compare vlm-vla compares VLM runs with policy runs in the same categories, and these runs have no "
            "such pair. Make the missing ones with `probe-kit ask` or `probe-kit extract`"
        )
    return RetentionTable(
        _called([row.row for row in drawn], names),
        _called(means, names),
        differences,
        {(location, probes.settings.target): probes for location, probes in results.items()},
        iterations,
        tuple(notes),
        compare_wordings([run for run in judged if not capture_only(run.episodes)]),
        gaps,
        unpaired,
    )


def _called(rows: Sequence[RetentionRow], names: Mapping[str, str]) -> list[RetentionRow]:
    """Return the rows with the names of their runs by location."""
    return [replace(row, run=replace(row.run, label=names[row.run.location])) for row in rows]


def _label_table(
    runs: Sequence[RunReader],
    targets: Sequence[str],
    views: Sequence[str] | None,
    iterations: Iterations,
    keys: Sequence[str | None] | None,
    family: Family,
    labels: Mapping[str, str] | None,
) -> RetentionTable:
    """Return the table of targets that are no side."""
    if not runs or not targets:
        raise UsageError("retention of a label needs at least one run and one target")
    results = read_labels(runs, targets, _key_of_run(keys, len(runs)))
    names = distinct_labels(runs, labels)
    rows = _called(label_rows(runs, results, views, iterations, family), names)
    full = {row.run.location: row.run.name for row in rows}
    notes = [*label_notes(runs, rows, family, full), *mixed_episodes(runs)]
    return RetentionTable(rows, [], results=results, iterations=iterations, notes=tuple(notes))


def _key_of_run(keys: Sequence[str | None] | None, runs: int) -> list[str | None]:
    if keys is not None and len(keys) != runs:
        raise UsageError(f"{len(keys)} keys for {runs} runs; give one per run, or None for the newest")
    return list(keys or [None] * runs)


def _check_doubles(runs: Sequence[RunReader]) -> None:
    """A run that counts twice makes every interval too narrow; a copy of its folder is the same run."""
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


def _read_probes(
    runs: Sequence[RunReader], keys: Sequence[str | None]
) -> tuple[dict[str, ProbeResults], list[str]]:
    """Probes by run, and a sentence for every run without, but for models that were only asked."""
    results: dict[str, ProbeResults] = {}
    missing = []
    for run, key in zip(runs, keys, strict=True):
        if key == "":
            if run.streams:
                missing.append(f"Success rates only: no probes of {run.location} belong to this table.")
            continue
        try:
            probes = load_side_results(run, key)
        except NoProbesError as error:
            if run.streams or ask_of(run) is None:
                shares = "Success rates" if ask_of(run) is None else "Answers"
                missing.append(f"{shares} only: {error}")
            continue
        results[str(run.location)] = probes
        if not is_current(probes.settings, run):
            missing.append(
                f"The probes {probes.key} of {run.location} are of other episodes than the run has now: "
                "accuracies and success rates do not belong together. "
                f"`probe-kit train {run.location}` fits new ones."
            )
    return results, missing
