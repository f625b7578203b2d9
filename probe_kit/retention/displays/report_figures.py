"""All figures that fit a table of runs: what `probe-kit retention --figures` saves and the report shows."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit.env.scoring.events import EVENTS
from probe_kit.errors import UsageError
from probe_kit.intervene.kinds.attention.attention_mass import stored_attention
from probe_kit.intervene.results.site_maps import stored_steering
from probe_kit.retention.behaviour.success_rate import listened
from probe_kit.retention.columns.text import model_name
from probe_kit.retention.compare.known_used import KnownUsedTable
from probe_kit.retention.displays.attention import attention_curve
from probe_kit.retention.displays.base.style import SIGNAL
from probe_kit.retention.displays.call_curves import aligned_curves, call_curves
from probe_kit.retention.displays.dose_response import dose_response
from probe_kit.retention.displays.final_positions import final_positions
from probe_kit.retention.displays.heat_table import (
    HeatTableDisplay,
    RetentionTableDisplay,
    SideTableDisplay,
    SuccessTableDisplay,
)
from probe_kit.retention.displays.iteration_maps import iteration_maps
from probe_kit.retention.displays.knowledge_action import KnowledgeActionDisplay
from probe_kit.retention.displays.known_used import KnownUsedDisplay
from probe_kit.retention.displays.layer_curves import layer_curve
from probe_kit.retention.displays.model_depth import model_depths
from probe_kit.retention.displays.outcome_rules import OutcomeRulesDisplay
from probe_kit.retention.displays.paired_layouts import PairedLayoutsDisplay
from probe_kit.retention.displays.role_curves import role_curves
from probe_kit.retention.displays.side_by_side import curves_side_by_side, has_maps, maps_side_by_side
from probe_kit.retention.displays.site_effect_curve import shown_passing, site_effect_curve
from probe_kit.retention.estimators.by_call import CallCurves, event_calls
from probe_kit.retention.estimators.retention import Iterations
from probe_kit.retention.joins import joins_of
from probe_kit.retention.rows.outcome_rules import can_be_judged, under_rule
from probe_kit.retention.table import RetentionTable
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.results.by_call import load_calls
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TableDisplay = type[SuccessTableDisplay] | type[SideTableDisplay] | type[RetentionTableDisplay]

SUFFIXES = (".png", ".pdf")

ONLY_FILLED = f"Only filled markers are evidence: {SIGNAL}"
DOTS = f"Dots mark evidence: {SIGNAL}"


@dataclass(frozen=True)
class ReportFigure:
    """A figure that can be drawn.

    name: file stem. subject: which numbers it shows, such as `behaviour` or `probes`. run: its position among the
    runs, None if it shows all of them. reading: how to read it, in plain language. is_table: its numbers are a
    table that is printed as such elsewhere.
    """

    name: str
    title: str
    subject: str
    reading: str
    run: int | None
    draw: "Callable[[], Figure]"
    is_table: bool = False

    @contextmanager
    def drawn(self) -> "Iterator[Figure]":
        """The figure, closed again afterwards, so that pyplot keeps none of many."""
        from matplotlib import pyplot as plt

        figure = self.draw()
        try:
            yield figure
        finally:
            plt.close(figure)


def collect_figures(runs: Sequence[RunReader], table: RetentionTable) -> list[ReportFigure]:
    """Every figure that the runs and the probes of their table allow. Nothing is drawn yet.

    Raises UsageError for a run that the table was not made of.
    """
    known = {row.run for row in table.rows}
    if strangers := [str(run.location) for run in runs if str(run.location) not in known]:
        raise UsageError(f"the table has no rows of {', '.join(strangers)}; make it of the runs that are drawn")
    results = [table.results.get(str(run.location)) for run in runs]
    called = {row.run: model_name(row) for row in table.rows}
    names = [called[str(run.location)] for run in runs]
    exhibits = [*_of_table(table, results, names), *_of_rules(runs)]
    exhibits += [
        *_side_by_side(results, names, table.iterations),
        *known_used_figures(joins_of(runs, table).found),
    ]
    for position, (name, run, probed) in enumerate(zip(run_names(runs), runs, results, strict=True)):
        if can_be_judged(run, table.rule, table.last_steps):
            exhibits += _of_run(name, position, under_rule(run, table.rule, table.last_steps))
        if probed is not None:
            exhibits += _of_probes(name, position, probed, table.iterations)
            exhibits += _of_calls(name, position, run, probed)
            exhibits += _site_effect_figures(name, position, run, probed)
        exhibits += [*_of_steering(name, position, run), *_of_attention(name, position, run)]
    return exhibits


def save_figures(exhibits: Sequence[ReportFigure], folder: Path) -> Iterator[Path]:
    """Draw exhibits into `folder` as PNG and PDF, one after the other; gives the path of every PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    for exhibit in exhibits:
        path = folder / f"{exhibit.name}{SUFFIXES[0]}"
        with exhibit.drawn() as figure:
            for suffix in SUFFIXES:
                figure.savefig(path.with_suffix(suffix), metadata=_metadata(suffix, exhibit, caption_of(figure)))
        yield path


def caption_of(figure: "Figure") -> str:
    """What the figure is about, in full; its footer holds the beginning."""
    return str(getattr(figure, "caption", ""))


def _metadata(suffix: str, exhibit: ReportFigure, caption: str) -> dict[str, str | None]:
    """The caption goes with the file, in what readers of its format show of it."""
    if suffix == ".pdf":
        return {"Title": exhibit.title, "Subject": f"{caption}. {exhibit.reading}", "CreationDate": None}
    return {"Title": exhibit.title, "Description": f"{caption}. {exhibit.reading}"}


def run_names(runs: Sequence[RunReader]) -> list[str]:
    """Names of the runs; a name that comes again is numbered."""
    names: list[str] = []
    for run in runs:
        name = run.location.name
        count = sum(other == name or other.startswith(f"{name}-") for other in names)
        names.append(f"{name}-{count + 1}" if name in names else name)
    return names


def _of_table(
    table: RetentionTable, results: Sequence[ProbeResults | None], names: Sequence[str]
) -> list[ReportFigure]:
    def show(display: _TableDisplay, name: str, title: str, subject: str) -> ReportFigure:
        return ReportFigure(
            name, title, subject, display.note, None, lambda: _figure(display.from_table(table)), True
        )

    acted = [row for row in table.rows if row.sr is not None]
    exhibits: list[ReportFigure] = []
    if acted:
        exhibits += [
            show(SuccessTableDisplay, "success", "Success rate", "behaviour"),
            show(SideTableDisplay, "sides", "Success rate by side", "behaviour"),
        ]
    if any(row.backbone_accuracy is not None for row in acted):
        exhibits.append(
            ReportFigure(
                "knowledge-action", "Knowledge and action", "retention",
                "Each point is one category: how well the answer can be read inside the model (across) and how "
                "often the model acts on it (up). Points far below the line are knowledge that does not reach the "
                "hand.",
                None, lambda: _figure(KnowledgeActionDisplay.from_table(table)),
            )
        )  # fmt: skip
    if any(row.retention is not None for row in table.rows):
        exhibits.append(show(RetentionTableDisplay, "retention", "Retention", "retention"))
    probed = [(one, name) for one, name in zip(results, names, strict=True) if one is not None]
    if len(probed) > 1:
        known, called = zip(*probed, strict=True)
        exhibits.append(
            ReportFigure(
                "model-depths", "Models by depth", "probes",
                "How far above chance the answer can be read, against depth as a fraction, so that models with "
                "different numbers of layers can be compared.",
                None, partial(model_depths, known, iterations=table.iterations, names=called),
            )
        )  # fmt: skip
    return exhibits


def _side_by_side(
    results: Sequence[ProbeResults | None], names: Sequence[str], iterations: Iterations
) -> list[ReportFigure]:
    """Of every view that two or more runs were probed in."""
    probed = [(one, name) for one, name in zip(results, names, strict=True) if one is not None]
    views = list(dict.fromkeys(view for one, _ in probed for view in one.settings.views))
    exhibits = []
    for view in views:
        own = [(one, name) for one, name in probed if view in one.settings.views]
        if len(own) < 2:
            continue
        known, called = zip(*own, strict=True)
        exhibits.append(
            ReportFigure(
                f"curves-side-by-side{_suffix(view, views)}",
                "Layer curves side by side" + (f", view {view}" * (len(views) > 1)), "probes",
                "How often a linear probe names the side of the correct picture, layer by layer, a line per run "
                f"on one scale; of several iterations the best of every layer. {ONLY_FILLED}. "
                "Bars are 95 % intervals at each line's best layer; the table says whether two runs differ.",
                None, partial(curves_side_by_side, known, called, view, iterations),
            )
        )  # fmt: skip
        if sum(has_maps(one, view) for one in known) > 1:
            exhibits.append(
                ReportFigure(
                    f"maps-side-by-side{_suffix(view, views)}",
                    "Layer × iteration side by side" + (f", view {view}" * (len(views) > 1)), "probes",
                    "Where and when the answer can be read while the action is made, a column per run. Colours "
                    f"run from chance to 100 % in every map. {DOTS}.",
                    None, partial(maps_side_by_side, known, called, view),
                )
            )  # fmt: skip
    return exhibits


def known_used_figures(joins: Sequence[KnownUsedTable]) -> list[ReportFigure]:
    """A figure per join of a VLM run and a policy run."""
    return [
        ReportFigure(
            f"known-used-{number}", "Known, encoded, used", "join",
            "Every question once: does the reader know the answer, does a probe read it in the policy, and does "
            "the action follow, each in both layouts. Red is lost: known and encoded, not used.",
            None, partial(_known_used, joined),
        )
        for number, joined in enumerate(joins, 1)
    ]  # fmt: skip


def _known_used(joined: KnownUsedTable) -> "Figure":
    return _figure(KnownUsedDisplay.from_join(joined))


def _of_rules(runs: Sequence[RunReader]) -> list[ReportFigure]:
    runs = [run for run in runs if getattr(run, "has_trajectories", False) and not run.episodes.empty]
    if not runs:
        return []
    return [
        ReportFigure(
            "outcome-rules", "The same episodes by every outcome rule", "behaviour",
            "What counts as an answer decides the success rate. A black mark is what a policy that does nothing "
            "would score by that rule: where there is one, the untouched cube already counts as put on a picture.",
            None, lambda: _figure(OutcomeRulesDisplay.from_runs(runs)),
        )
    ]  # fmt: skip


def _of_run(name: str, position: int, run: RunReader) -> list[ReportFigure]:
    if listened(run.episodes):
        return []
    exhibits = [
        ReportFigure(
            f"{name}-paired-layouts", "The same question, pictures swapped", "behaviour",
            "Every question is asked twice, with the two pictures exchanged. Knowing the answer means right both "
            "times; always going to one side means right once. Bold p: more items are right twice than wrong "
            "twice, beyond luck.",
            position, lambda: _figure(PairedLayoutsDisplay.from_run(run)),
        )
    ]  # fmt: skip
    if {"cube_x", "cube_y"} <= set(run.episodes) and getattr(run, "settings", {}).get("scene"):
        exhibits.append(
            ReportFigure(
                f"{name}-final-positions", "Where the cube ended", "behaviour",
                "The table from above, the robot below the picture. An episode counts as an answer if the middle "
                "of the cube ends inside a dashed line; “unmoved” means that the cube was never carried "
                "anywhere.",
                position, partial(final_positions, run),
            )
        )  # fmt: skip
    return exhibits


def _of_probes(name: str, position: int, results: ProbeResults, iterations: Iterations) -> list[ReportFigure]:
    views = results.settings.views
    exhibits = [
        ReportFigure(
            f"{name}-layer-curves{_suffix(view, views)}", "Layer curves" + (f", view {view}" * (len(views) > 1)),
            "probes",
            "How often a linear probe names the side of the correct picture in episodes it has not seen, layer by "
            f"layer; the part that makes the action has a line per iteration. {ONLY_FILLED}, against the best "
            "layer of relabelled data. The grey band is what no knowledge looks like; a caret "
            "marks the best layer, or all that tie.",
            position, partial(layer_curve, results, view, iterations),
        )
        for view in views
    ]  # fmt: skip
    scores = results.scores
    exhibits += [
        ReportFigure(
            f"{name}-iteration-maps{_suffix(view, views)}",
            "Layer × iteration" + (f", view {view}" * (len(views) > 1)), "probes",
            "The action is made in several iterations (flow-matching steps or action tokens). Dark cells: "
            f"the answer can be read at that layer and iteration. {DOTS}.",
            position, partial(iteration_maps, results, view, stream),
        )
        for view in views
        for stream in scores.loc[scores["part"] == "action", "stream"].unique()
        if ((scores["view"] == view) & (scores["stream"] == stream) & scores["iteration"].notna()).any()
    ]  # fmt: skip
    for stream, rows in scores.groupby("stream", sort=False):
        if rows["view"].nunique() > 1:
            exhibits.append(
                ReportFigure(
                    f"{name}-roles-{stream}", f"Whose tokens carry the answer: {stream}", "probes",
                    "The same probes on the mean of one kind of token at a time.",
                    position, partial(role_curves, results, str(stream), iterations=iterations),
                )
            )  # fmt: skip
    return exhibits


def _site_effect_figures(name: str, position: int, run: RunReader, results: ProbeResults) -> list[ReportFigure]:
    """Only where an interchange is stored with the run."""
    if not set(shown_passing(run)) & set(results.settings.categories):
        return []
    view = results.settings.views[0]
    return [
        ReportFigure(
            f"{name}-causes", "Readable and used", "interventions",
            "Where a probe reads the answer, and how many episodes turn to the other side when the tokens of one "
            "layer are taken from the same inference before exchanged pictures. A layer that is readable and "
            "turns nothing is read by nothing behind it.",
            position, partial(site_effect_curve, run, results, view),
        )
    ]  # fmt: skip


def _of_steering(name: str, position: int, run: RunReader) -> list[ReportFigure]:
    """Only where a steering is stored with the run."""
    if not stored_steering(run):
        return []
    return [
        ReportFigure(
            f"{name}-doses", "How much of a direction turns the action", "interventions",
            "Episodes that turn to the side they are pushed to, minus those that turn from it, by how much of the "
            "direction is added; filled: beyond random directions of the same norm (the band). One side may be "
            "saturated, and beyond about two norms of the tokens any direction breaks the hand.",
            position, partial(dose_response, run),
        )
    ]  # fmt: skip


def _of_attention(name: str, position: int, run: RunReader) -> list[ReportFigure]:
    """Only where attention is stored with the run."""
    if not stored_attention(run):
        return []
    return [
        ReportFigure(
            f"{name}-attention", "What is weighed", "interventions",
            "How much of the attention that what acts pays lies on the pictures, the words and its own tokens, by "
            "the block whose keys are read. Dots: single heads; bars: from the least to the most of any "
            "iteration. It describes and is no cause: what is weighed need not be used, and it enters no verdict.",
            position, partial(attention_curve, run),
        )
    ]  # fmt: skip


def _of_calls(name: str, position: int, run: RunReader, results: ProbeResults) -> list[ReportFigure]:
    """Only where a later inference was probed as well."""
    calls = load_calls(run, results)
    if len(calls) < 2:
        return []
    views, events = results.settings.views, event_calls(run)
    exhibits = [
        ReportFigure(
            f"{name}-calls{_suffix(view, views)}", "Over the episode" + (f", view {view}" * (len(views) > 1)),
            "probes",
            f"The best site of each part at every inference that was captured, counted from 0. {ONLY_FILLED}; "
            "dotted: what the best site of relabelled data stays below. An answer that is not there at "
            "call 0 may not be needed yet: upright lines say when the arm set off, grasped, chose a side, let go.",
            position, partial(call_curves, calls, view, events),
        )
        for view in views
    ]  # fmt: skip
    curves = [CallCurves.of(calls, category, views[0], events) for category in results.settings.categories]
    shown = [event for event in EVENTS if any(_aligned(one, event) for one in curves)]
    return exhibits + [
        ReportFigure(
            f"{name}-calls-{event.replace(' ', '-')}", f"Around an event: {event}", "probes",
            "The same, with every episode's inferences counted from its own event: 0 is the last one before it.",
            position, partial(aligned_curves, calls, event, views[0], events),
        )
        for event in shown
    ]  # fmt: skip


def _aligned(curves: CallCurves, event: str) -> bool:
    return any(curves.aligned(stream, event) is not None for stream in curves.streams)


def _suffix(view: str, views: Sequence[str]) -> str:
    """The first view needs no name in a file's name."""
    return "" if view == views[0] else f"-{view.replace(':', '-')}"


def _figure(
    display: "HeatTableDisplay | KnownUsedDisplay | OutcomeRulesDisplay | KnowledgeActionDisplay"
    " | PairedLayoutsDisplay",
) -> "Figure":
    from matplotlib.figure import Figure

    axes = display.plot().ax_
    assert axes is not None
    figure = axes.figure
    assert isinstance(figure, Figure)
    return figure
