"""The summary: in every format a row and a short sentence per category, and the next step."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from probe_kit._system.escaping import as_argument
from probe_kit._tables.numbers import Limits, points, whole_percent, with_sign
from probe_kit._tables.table import Cell, Heading, Table, TableRow, absent
from probe_kit.intervene.verdict import UseVerdict, describe_readouts, items_to_decide, more_groups, size_of_groups
from probe_kit.retention.behaviour import Regime
from probe_kit.retention.columns.text import (
    P_DECIDES,
    above_chance,
    by_run,
    chance_only,
    conclusion,
    difference_test,
    is_probed,
    is_vlm,
    knows,
    label_finding,
    model_name,
    models_p,
    more_items,
    name_of,
    retention_value,
    title_of,
    verdict,
    why_unprobed,
)
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.rows.row import MEAN, RetentionRow, StreamPart
from probe_kit.statistics.label_permutations import permutations_for
from probe_kit.statistics.sufficiency import probe_command
from probe_kit.train.results.control_scores import RANDOM_FEATURES, UNTRAINED

MOST_WORDS = 30
"""Largest number of words of a sentence with the name of its category.

A number is a word.
"""
MOST_NUMBERS = 2
"""Largest number of numbers in a sentence; the others are in tables."""
_CONTROLS = {RANDOM_FEATURES: "random features", UNTRAINED: "an untrained network"}


def finding(row: RetentionRow, vlm: RetentionRow | None = None) -> str:
    """Return the finding of a category: a verdict, a colon, and where on the way to the action the answer is lost.

    Args:
        row: The row of a policy, of a VLM or of a label.
        vlm: The row of a VLM that answered the same questions; None without one.
    """
    if row.label:
        return label_finding(row)
    if is_vlm(row):
        return _vlm_sentence(row)
    use = row.image_swap.use
    if use is None:
        return _without_swap(row, vlm)
    if use.is_bounded and is_probed(row) and not _is_encoded(row):
        return (
            f"{_missing_signal(row)}: {_list_clauses(_knows(vlm), _unread(row))}; the action does not follow it."
        )
    return _use_sentence(row, vlm, use)


def _list_clauses(*clauses: str) -> str:
    return "; ".join(filter(None, clauses))


def count_words(sentence: str) -> int:
    """Return the number of words and numbers."""
    return len(re.findall(r"[\w’'-]+", sentence))


# -- VLMs ----------------------------------------------------------------------------------------------------


def _vlm_sentence(row: RetentionRow) -> str:
    rate = f"{whole_percent(row.success.sr)} %"
    if knows(row):
        inside = ", and probes read it in the backbone" if _is_encoded(row) else ""
        return f"known: the VLM answers right in {rate}{inside}."
    if (row.success.share_outside or 0) > 0.5:
        return (
            f"not shown: no answer could be read in {whole_percent(row.success.share_outside)} % of the episodes."
        )
    inside = ", yet probes read the answer in the backbone" if _is_encoded(row) else ""
    return f"not shown: the VLM answers right in {rate}, {_against_guessing(row)}{inside}."


def _against_guessing(row: RetentionRow) -> str:
    return "less often than guessing" if row.success.regime == Regime.FAILURE else "which guessing can reach"


# -- policies ----------------------------------------------------------------------------------------------------


_MOST_WORDS_OF_CLAUSES = 25
"""Largest number of words of a sentence to which the success rate is added."""
_READ = "probes read the answer in the backbone"


def _sentence(verdict: str, *clauses: str, row: RetentionRow, stages: str = "") -> str:
    """Return verdict and clauses, the stages, and the success rate; what is long is a sentence of its own.

    Args:
        verdict: The verdict in a word or two.
        clauses: Its reasons; empty ones are left out.
        row: The row of one category of a policy.
        stages: Clause on where the answer can be read; empty if it is among the clauses.
    """
    text = ". ".join(filter(None, (f"{verdict}: {_list_clauses(*clauses)}", f"{stages[:1].upper()}{stages[1:]}")))
    if row.success.sr is None or knows(row):
        success = _success(row) + _compare_with_guessing(row)
        if len(re.findall(r"\d+", text + success)) > MOST_NUMBERS:
            success = _success(row)
        is_short = count_words(text) + count_words(success) < _MOST_WORDS_OF_CLAUSES
        return f"{text}; {success}." if is_short else f"{text}. {success[0].upper()}{success[1:]}."
    is_below = row.success.regime == Regime.FAILURE
    against = "lower than guessing gives" if is_below else "compatible with guessing"
    return f"{text}. The success rate of {whole_percent(row.success.sr)} % is {against}."


def _open_sentence(head: str, row: RetentionRow, vlm: RetentionRow | None, needed: str = "") -> str:
    """Return the sentence of an answer that probes read and whose use is open.

    It has the evidence of the action stream and the rate of guessing where there is room for them.

    Args:
        head: What is open.
        row: The row of one category of a policy.
        vlm: The row of a VLM that answered the same questions; None without one.
        needed: How much data would decide; empty if that is not the question.
    """
    knowledge = _knows(vlm)
    read = "probes read it in the backbone" if knowledge else _READ
    guessing = _compare_with_guessing(row)
    stream = _action_evidence(row)
    # From most to least said: the first that is short enough.
    for in_action, guess in ((stream, guessing), (stream, ""), ("", guessing), ("", "")):
        stages = f"{knowledge} and {read}{in_action}" if knowledge else f"{read}{in_action}"
        sentence = f"{head}: {_list_clauses(stages, needed, _success(row))}{guess}."
        if count_words(sentence) < _MOST_WORDS_OF_CLAUSES and len(re.findall(r"\d+", sentence)) <= MOST_NUMBERS:
            break
    return sentence


def _action_evidence(row: RetentionRow) -> str:
    """Return the evidence of probes in the action stream by its verdict; *not shown* claims no absence."""
    if row.action.verdict is None:
        return ""
    words = " and" if _holds(row.action) else f", {'absent' if row.action.verdict == 'absent' else 'not shown'} in"
    return f"{words} the {row.run.action_name}"


def _knows(vlm: RetentionRow | None) -> str:
    """Return a clause on what the VLM knows; empty without one, or if its answers do not show that."""
    return "the VLM knows the answer" if vlm is not None and knows(vlm) else ""


def _stages(row: RetentionRow, vlm: RetentionRow | None) -> str:
    """Return a clause: whether the VLM knows the answer, and in which streams of the policy probes read it."""
    knowledge = _knows(vlm)
    if not _is_encoded(row):
        return knowledge
    stream = f"the {row.run.action_name}"
    if row.action.verdict is None:
        in_action = ""
    elif _holds(row.action):
        in_action = f" and {stream}"
    else:
        in_action = f" but {'not' if row.action.verdict == 'absent' else 'do not show it'} in {stream}"
    return f"{knowledge} and probes read it in the backbone{in_action}" if knowledge else f"{_READ}{in_action}"


def _use_sentence(row: RetentionRow, vlm: RetentionRow | None, use: UseVerdict) -> str:
    """Return the sentence of a row whose pictures were swapped."""
    verdict, what = use.finding
    if verdict == "used":
        if not _is_encoded(row):
            return _sentence(verdict, what, *_missing(row), row=row)
        yet = "" if row.action.verdict is None or _holds(row.action) else "yet "
        return _sentence(verdict, f"{_stages(row, None)}, {yet}the action follows it", row=row)
    if verdict == "not used" and use.is_of_first_chunk and knows(row):
        what = "the first actions do not follow the answer, later ones may"
        return _sentence("not used at first", what, *_missing(row), row=row, stages=_stages(row, vlm))
    if verdict == "not used":
        stages = _stages(row, vlm)
        is_lost = row.action.verdict is not None and not _holds(row.action) and _is_encoded(row)
        text = f"{stages}{';' if is_lost else ', but'} {what.replace('the answer', 'it')}" if stages else what
        return _sentence(verdict, text, *_missing(row), row=row)
    if use.behaviour == "undecided" and not use.lacks_control:
        if _is_encoded(row):
            needed = more_groups(row.image_swap, row.success.n_groups or 0)
            return _open_sentence(f"encoded, {verdict}", row, vlm, needed)
        needed = items_to_decide(row.image_swap, row.success.n_items or 0, row.success.n_groups or 0)
        knowledge = _knows(vlm)
        return _sentence(verdict, knowledge, *_missing(row, "it" if knowledge else "the answer"), needed, row=row)
    if verdict in ("not decisive", "use undecided"):
        return _sentence(verdict, what, *_missing(row), row=row, stages=_stages(row, vlm))
    return _sentence(verdict, what, row=row)


def _holds(part: StreamPart) -> bool:
    """Whether the answer is shown in a stream; one without a score shows nothing."""
    return part.has_signal and part.score is not None


def _is_encoded(row: RetentionRow) -> bool:
    return _holds(row.backbone)


def _missing(row: RetentionRow, answer: str = "it") -> list[str]:
    """Return the reason why the answer is not known to be in the backbone; nothing where it is."""
    if not is_probed(row):
        return [why_unprobed(row)]
    if _is_encoded(row):
        return []
    return [f"probes do not show {answer} in the backbone"]


def _unread(row: RetentionRow) -> str:
    """Return the finding of probes in a backbone without signal."""
    part, items = row.backbone, row.success.n_items
    if part.score is None:
        return "too few groups of items to measure the answer in the backbone"
    if part.verdict == "absent":
        return f"probes of {items} items do not find the answer in the backbone"
    if part.remedy:
        few = "permutations" if "permutations" in part.remedy else "groups"
        return f"too few {few} to show it, {part.remedy}"
    missed = [_CONTROLS.get(name, name) for name, better in part.exceeds.items() if better is False]
    if part.exceeds["chance"]:
        return f"probes of the backbone do no better than {' and '.join(missed)}"
    return more_items(row) or f"{items} items are too few to tell what the backbone holds"


def _compare_with_guessing(row: RetentionRow) -> str:
    """Return a clause that follows the success rate; empty without one."""
    if row.success.sr is None:
        return ""
    if knows(row):
        return ", guessing 50 %"
    return ", less than guessing" if row.success.regime == Regime.FAILURE else ", guessing possible"


def _success(row: RetentionRow) -> str:
    """Return the success of a policy in words."""
    if row.success.sr is None:
        return "the model did not act" if row.run.capture_only else "success is not known"
    return f"success {whole_percent(row.success.sr)} %"


def _missing_signal(row: RetentionRow) -> str:
    return "absent" if row.backbone.verdict == "absent" else "not shown"


def _without_swap(row: RetentionRow, vlm: RetentionRow | None) -> str:
    """Return the sentence of a row whose pictures were not swapped."""
    if is_probed(row) and _is_encoded(row):
        tested = ", use not tested" if row.success.sr is not None else ""
        return _open_sentence(f"encoded{tested}", row, vlm)
    if is_probed(row):
        return _sentence(_missing_signal(row), _knows(vlm), _unread(row), row=row)
    if row.success.sr is None:
        return f"not measured: {_success(row)}, and {why_unprobed(row)}."
    words = {Regime.KNOWLEDGE: "success", Regime.FAILURE: "failure"}
    head = words.get(row.success.regime or Regime.NO_RELIABLE_KNOWLEDGE, "success not shown")
    against_guessing = "" if head == "success" else f", {_against_guessing(row)}"
    return (
        f"{head}: the cube ends right in {whole_percent(row.success.sr)} %{against_guessing}; {why_unprobed(row)}."
    )


# -- what to do next ----------------------------------------------------------------------------------------------


def next_step(rows: Sequence[RetentionRow]) -> str:
    """Return the command for the open question of the first run, and its purpose; empty without a policy."""
    acts = [row for row in rows if not row.label and row.category != MEAN and not is_vlm(row)]
    if not acts:
        return ""
    of_run = [row for row in acts if row.key == acts[0].key]
    location = of_run[0].run.location
    run = as_argument(location)
    has_activations = of_run[0].run.action_stream is not None
    command = probe_command(location, {row.category: row.success.n_groups or 0 for row in of_run})
    if has_activations and not any(map(is_probed, of_run)) and command:
        return f"next: {command}  where inside the answer can be read"
    if has_activations and any(row.image_swap.use is None for row in of_run) and not of_run[0].run.capture_only:
        return f"next: probe-kit intervene {run}  whether the action follows the answer"
    if any("permutations" in row.backbone.remedy for row in of_run):
        fewest = permutations_for()
        return f"next: probe-kit train {run} --permutations 200  because fewer than {fewest} show nothing"
    if any(is_probed(row) and not _is_encoded(row) and row.backbone.verdict != "absent" for row in of_run):
        return "next: probe-kit power  how many items would show what is open"
    return f"next: probe-kit view {run}  episode by episode, in a browser"


MARK = "✓"
"""Mark after a share: the stream exceeds chance and every control, or the regime of the behaviour is knowledge."""
_TERMS = {
    "metric": ("Metric", "of a label, balanced accuracy of classes, R² of quantities"),
    "backbone above chance": (
        "Above chance",
        "score minus the mean score with permuted labels; other groups chose the layer",
    ),
    "VLM %": (
        "VLM",
        "share of its answers that are right. A name such as vlm-tiny · p2 · 640×480 ends with the prompt, p2, "
        "and the picture's size in pixels",
    ),
    "backbone %": ("Backbone", "accuracy of probes of the backbone; its layer was chosen on other questions"),
    "action %": ("Action", "the same for the layers that produce the action"),
    "success %": ("Success", "the cube ends on the correct picture"),
    "retention": (
        "Retention",
        "share of the backbone's accuracy above chance that is left in the action: 1 is all, 0 is none. The mean "
        "row is computed from the mean accuracies",
    ),
    "p (Holm)": (
        "p",
        f"exact, of a difference in success or answers, (corrected for all categories and pairs); {P_DECIDES}",
    ),
    "p over models (least)": (
        "p over models",
        "exact, models as the unit (the least that so few models allow)",
    ),
}
"""The name and the meaning of a column in the legend; the last two are of differences."""
_TESTS = ("p (Holm)", "p over models (least)")
HEADING_HELP = {heading: f"{meaning[:1].upper()}{meaning[1:]}." for heading, (_, meaning) in _TERMS.items()} | {
    "verdict": "What all numbers of the category say together."
}
"""The meanings of the columns as entries of the glossary."""


@dataclass(frozen=True)
class CategorySummary:
    """One category of a policy, or of a VLM alone; or a label.

    Attributes:
        vlm: The VLM's row of the same category; None without one.
    """

    row: RetentionRow
    vlm: RetentionRow | None = None

    @property
    def name(self) -> str:
        """The category as it is spelt at the beginning of a sentence, or the label."""
        return name_of(self.row)

    @property
    def cells(self) -> tuple[Cell, ...]:
        """The cells under `HEADINGS`."""
        row, vlm = self.row, self.row if is_vlm(self.row) else self.vlm
        acts = None if is_vlm(row) else row
        if row.label:
            label = Cell(row.metric), *map(_above, (row.backbone, row.action))
            return (*label, *[Cell(None)] * 4, _retention(row), Cell(""))
        return (
            *[Cell(None)] * 3,
            Cell(None) if vlm is None else _share(vlm.success.sr, vlm.success.ci, knows(vlm)),
            _share(row.backbone.score, row.backbone.ci, _is_marked(row.backbone)),
            _share(row.action.score, row.action.ci, _is_marked(row.action)),
            Cell(None) if acts is None else _share(acts.success.sr, acts.success.ci, knows(acts)),
            _retention(row),
            Cell("" if row.category == MEAN else str(verdict(row))),
        )

    @property
    def finding(self) -> str:
        """The finding in one short sentence, to follow the category's name."""
        return finding(self.row, self.vlm)

    @property
    def details(self) -> str:
        """The conclusion from all numbers of the row, and what to do next; the numbers are in tables."""
        return f"{self.name}{'' if self.row.label else ':'} {conclusion(self.row)}"


HEADINGS = (
    "metric", "backbone above chance", "action above chance",
    "VLM %", "backbone %", "action %", "success %", "retention", "verdict",
)  # fmt: skip
"""The columns of the summary: the first three are of labels, others of sides.

Columns in which no row has anything to show are left out.
"""


def _is_marked(part: StreamPart) -> bool:
    return part.has_signal and part.is_controlled


def _share(value: float | None, limits: Limits | None, marked: bool) -> Cell:
    return Cell(value, whole_percent, limits, after=f" {MARK}" if marked and value is not None else "")


def _above(part: StreamPart) -> Cell:
    """Return the score of a label above chance with its interval, marked where there is signal."""
    return replace(above_chance(part), after=f" {MARK}" if _is_marked(part) else "")


def _retention(row: RetentionRow) -> Cell:
    if any(part.score is None and part.above is None for part in (row.backbone, row.action)):
        return Cell(None)
    return retention_value(row)


# -- runs --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RunSummary:
    """A row and a sentence per category of a run.

    Attributes:
        run: Name of the run.
        vlm: Name of the model that was asked the same questions, or empty.
        mean: The mean over the categories; None of labels, whose metrics differ.
    """

    run: str
    vlm: str
    categories: tuple[CategorySummary, ...]
    mean: CategorySummary | None

    @property
    def title(self) -> str:
        """The names of the run and of its VLM."""
        return " · ".join(name for name in (self.run, self.vlm) if name)

    @property
    def rows(self) -> tuple[CategorySummary, ...]:
        """The categories, and their mean where there is one."""
        return self.categories if self.mean is None else (*self.categories, self.mean)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The findings, a sentence per category, all beginning at one column."""
        width = max(len(category.name) for category in self.categories)
        return tuple(f"{category.name.ljust(width)}  {category.finding}" for category in self.categories)


def summary_table(summaries: Sequence[RunSummary], differences: Sequence[Difference] = ()) -> Table:
    """Return a row per category and run, and the mean; below them the differences of runs.

    Labels have a row per target, category and view. Columns in which no row has anything to show are left out.
    """
    every = [category for run in summaries for category in run.rows]
    names = list(dict.fromkeys(category.name for category in every if category.row.category != MEAN))
    if any(len(run.categories) > 1 for run in summaries):
        names += [category.name for category in every if category.row.category == MEAN][:1]
    lines: list[TableRow] = []
    for name in names:
        for run in summaries:
            of_name = [category for category in run.rows if category.name == name]
            lines += [_row(summary, run.run) for summary in of_name]
        for row in differences:
            if title_of(row.category) == name:
                cells = (Cell(name), Cell(f"{row.group} − {row.minus}"), Cell(""), *_difference_cells(row))
                lines.append(TableRow(cells, row.category == MEAN, is_difference=True))
    of_labels = any(category.row.label for category in every)
    headings = ("label" if of_labels else "category", "run", "view", *HEADINGS, *_TESTS)
    title = " · ".join(dict.fromkeys(run.title for run in summaries))
    table = Table(
        title=f"Labels, and what reaches the action: {title}" if of_labels else f"Summary: {title}",
        headings=tuple(Heading(name, HEADING_HELP.get(name, "")) for name in headings),
        rows=tuple(lines),
        names=3,
        overflow="fold",
    )
    has_views = of_labels and len({category.row.view for category in every}) > 1
    is_needed = {"run": len(summaries) > 1 or bool(differences), "view": has_views}
    table = table.only([at for at, name in enumerate(headings) if is_needed.get(name, True)]).filled()
    legend = [": ".join(_TERMS[name]) for name in table.columns if name in _TERMS]
    readouts = describe_readouts(summary.row.image_swap.use for run in summaries for summary in run.categories)
    counts = [
        (summary.row.success.n_items, summary.row.success.n_groups)
        for summary in every
        if summary.row.category != MEAN
    ]
    size = size_of_groups(
        (f"{summary.finding} {summary.details}" for summary in every if summary.row.category != MEAN),
        [(items or 0, groups or 0) for items, groups in counts],
    )
    return replace(table, notes=(*legend, *filter(None, [readouts, size]), *_marks(summaries, table)))


def _row(category: CategorySummary, run: str) -> TableRow:
    names = map(Cell, (category.name, run, category.row.view or ""))
    return TableRow((*names, *category.cells, *[Cell("")] * len(_TESTS)), category.row.category == MEAN)


def _marks(summaries: Sequence[RunSummary], table: Table) -> list[str]:
    """Return the meaning of brackets and of the mark where a cell has them, and a warning of missing controls."""
    notes, cells = [], [text for line in table.texts for text in line]
    if any("[" in text for text in cells):
        notes.append("in brackets: the 95 % interval, with groups as the unit")
    if any(MARK in text for text in cells):
        notes.append(_meaning_of_mark(table))
    warning = chance_only(
        [category.row for run in summaries for category in run.categories if not category.row.label]
    )
    return [*notes, warning] if warning else notes


def _meaning_of_mark(table: Table) -> str:
    """Return what the mark says of the table's columns: probes have controls, answers and success have none."""
    has_probes = not {"backbone %", "backbone above chance"}.isdisjoint(table.columns)
    has_behaviour = not {"VLM %", "success %"}.isdisjoint(table.columns)
    if has_probes and has_behaviour:
        return f"{MARK} above chance; of probes, above every control that was run too"
    return f"{MARK} above chance, and above every control that was run" if has_probes else f"{MARK} above chance"


def _difference_cells(row: Difference) -> tuple[Cell, ...]:
    sr, backbone, action = (
        Cell(value, points, limits)
        for value, limits in ((row.sr, row.sr_ci), (row.backbone, row.backbone_ci), (row.action, row.action_ci))
    )
    none = absent("")
    answered, acted = (sr, none) if row.mode == "answers" else (none, sr)
    ratio = Cell(row.retention, with_sign, row.retention_ci)
    test, over_models = (difference_test(row), none) if row.sr_models is None else (none, models_p(row.sr_models))
    return none, none, none, answered, backbone, action, acted, ratio, none, test, over_models


def summarise_runs(all_rows: Sequence[RetentionRow]) -> list[RunSummary]:
    """Return a summary per run and group of a table's rows and means, of sides by the first view of each.

    Policies have the answers of a VLM of their suite. A VLM has a summary of its own only where no policy of its
    suite is in the table. Labels have one of all their rows, without a mean.
    """
    labels = [
        RunSummary(model_name(rows[0]), "", tuple(map(CategorySummary, rows)), None)
        for rows in by_run([row for row in all_rows if row.label])
    ]
    rows = [row for row in all_rows if not row.label and row.category != MEAN]
    means = [row for row in all_rows if not row.label and row.category == MEAN]
    answers = [
        row
        for row in rows
        if is_vlm(row) and row.answers.asked_for in (None, "target") and row.answers.picture != "none"
    ]
    answer_means = {row.run.location: row for row in means if is_vlm(row)}
    # A VLM is printed with the policies of its suite, and by itself only where there is none.
    policies = by_run([row for row in rows if not is_vlm(row)])
    suites = {row.run.suite for row in rows if not is_vlm(row)}
    alone = by_run([row for row in rows if is_vlm(row) and row.run.suite not in suites])
    mean_of = {(mean.key, mean.view): mean for mean in means}
    summaries = []
    for of_run in (*policies, *alone):
        first_view = [row for row in of_run if row.view == of_run[0].view]
        head = first_view[0]
        same = [row for row in answers if not is_vlm(head) and row.run.suite == head.run.suite]
        vlm_rows = {row.category: row for row in same if row.run.location == same[0].run.location}
        categories = tuple(CategorySummary(row, vlm_rows.get(row.category)) for row in first_view)
        vlm_mean = answer_means.get(same[0].run.location) if same else None
        mean = CategorySummary(mean_of[head.key, head.view], vlm_mean)
        summaries.append(RunSummary(model_name(head), model_name(same[0]) if same else "", categories, mean))
    return [*summaries, *labels]
