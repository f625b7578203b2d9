"""Figures of stored interventions: where an answer passes and is read, attention, and doses of a direction."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.escaping import as_argument
from probe_kit._system.types import PictureArray
from probe_kit.errors import NoInterventionsError
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.kinds.attention import (
    ACTION,
    CORRECT,
    OTHER,
    AttentionShares,
    Axis,
    stored_attention,
    stored_patch_attention,
)
from probe_kit.intervene.kinds.interchange import (
    BACKBONE,
    HALF_DIFFERENCE,
    PatchEffect,
    stored_site_effects,
    stored_steering,
    unit_of_doses,
)
from probe_kit.intervene.kinds.knockout import KnockoutEffect, by_role, stored_knockouts, windows_by_growth
from probe_kit.intervene.places import ALL, TILE_ROLES, PlaceName
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.display import (
    GREY,
    Display,
    ProvenanceLine,
    caption,
    draw_series,
    in_panels,
    layer_axis,
    panels,
    probed_curve,
    scores_of,
    series,
    significance_handles,
)
from probe_kit.retention.displays.report_figure import FigureSource, ReportFigure, in_report
from probe_kit.runs.reader import RunReader
from probe_kit.runs.thumbnails import episode_frames
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# -- readable and used ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Points:
    """One line: percent by layer, and whether each point is significant, family-wise."""

    layers: NDArray[np.int64]
    percent: NDArray[np.float64]
    significant: NDArray[np.bool_]


@dataclass(kw_only=True)
class SiteEffectDisplay(Display):
    """Curves by backbone layer: held-out accuracy of probes, and the episodes that turn when tokens are exchanged.

    Filled markers are significant, family-wise.

    Attributes:
        readable: Accuracy in percent.
        passes: By role, share of episodes in percent whose action turns to the side of the swapped images, minus
            those that turn from it.
        read: The same for the keys and values that the acting part reads of each block; None where it was not
            tested.
    """

    measure: str = "% of episodes"
    category: str
    readable: Points
    passes: dict[str, Points]
    read: Points | None

    @classmethod
    def from_run(
        cls,
        run: RunReader,
        results: ProbeResults,
        category: str,
        view: str = "mean",
        stored: Mapping[str, Sequence[PatchEffect]] | None = None,
    ) -> Self:
        """Read the stored interchange and probes of a run.

        Args:
            run: The run that stores the interchange.
            results: Probes of the run.
            category: A category that was probed.
            view: A view that was probed.
            stored: Result of `shown_passing`; None reads it from the run.

        Raises:
            UnknownSiteError: For a view that was not probed.
            UnknownCategoryError: For a category that was not probed.
            NoInterventionsError: If no interchange is stored of the category.
        """
        rows = (shown_passing(run) if stored is None else stored).get(category, [])
        if not rows:
            raise NoInterventionsError(
                f"{run.location} has no stored interchange of {category!r} in a layer of the backbone or of the "
                f"keys and values. Run `probe-kit intervene {as_argument(run.location)} --kind interchange`"
            )
        probed_curve(results, view, category)  # raises where there is none; `scores_of` would be empty
        scores = scores_of(results, category, view, BACKBONE).sort_values("layer")
        by_role: dict[str, list[PatchEffect]] = {}
        for row in rows:
            if _stream(row) == BACKBONE:
                by_role.setdefault(row.role, []).append(row)
        read = [row for row in rows if _stream(row) == KV_STREAM]
        return cls(
            title=title_of(category),
            category=category,
            readable=Points(
                scores["layer"].to_numpy(int), 100 * scores["accuracy"].to_numpy(float),
                (scores["p_fwe"] < SIGNIFICANCE).to_numpy(bool),
            ),
            passes={role: _points(of_role) for role, of_role in by_role.items()},
            read=_points(read) if read else None,
            certificates=(ProvenanceLine.of_results(results, view),),
        )  # fmt: skip

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handles of filled and open markers."""
        return significance_handles(f"p < {SIGNIFICANCE}, family-wise")

    def draw(self, axes: "Axes") -> None:
        """Draw a line for probes, one for every role, one for `kv`."""
        axes.axhline(100 * CHANCE, color="0.45", lw=1, ls=(0, (1, 1)), label="chance of probes")
        lines = {
            "readable (probe)": self.readable,
            **{f"passes: {role}": passing for role, passing in self.passes.items()},
        }
        if self.read is not None:
            lines["read (keys and values)"] = self.read
        for position, (label, points) in enumerate(lines.items()):
            x = points.layers.astype(np.float64) + 0.05 * (position - 2)
            draw_series(axes, series(position), x, points.percent, points.significant, label)
        layer_axis(axes, int(self.readable.layers.max()) + 1)
        axes.set_ylim(-12, 108)


def shown_passing(run: RunReader) -> dict[str, list[PatchEffect]]:
    """Return by category the effects that a figure by layers shows: the backbone at every role, `kv` as a whole.

    Categories of which nothing of the two is stored are not in it.

    Args:
        run: The run that stores the interventions.

    Raises:
        RunDamagedError: If stored effects were changed.
    """
    by_category = {
        category: [
            row
            for row in rows
            if PlaceName.parse(row.sites).is_whole_layer
            and (_stream(row) == BACKBONE or (_stream(row) == KV_STREAM and row.role == ALL))
        ]
        for category, rows in stored_site_effects(run).items()
    }
    return {category: rows for category, rows in by_category.items() if rows}


def site_effect_curve(run: RunReader, results: ProbeResults, view: str = "mean") -> "Figure":
    """Return a figure with a panel per category of which an interchange is stored.

    Args:
        run: The run that stores the interchange.
        results: Probes of the run.
        view: View of the probes.

    Raises:
        NoInterventionsError: If there is none.
    """
    stored = shown_passing(run)
    names = [name for name in results.settings.categories if name in stored] or ["any"]
    return in_panels([SiteEffectDisplay.from_run(run, results, name, view, stored) for name in names])


def _points(rows: Sequence[PatchEffect]) -> Points:
    return Points(
        np.array([PlaceName.parse(row.sites).layer for row in rows], np.int64),
        np.array([100 * row.net for row in rows]),
        np.array([row.is_significant for row in rows], bool),
    )


def _stream(row: PatchEffect) -> str:
    return PlaceName.parse(row.sites).stream


@in_report(13)
def site_effect_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield a figure per run with a stored interchange of a probed category."""
    for drawn in source.runs:
        if drawn.results is None or not set(shown_passing(drawn.run)) & set(drawn.results.settings.categories):
            continue
        yield ReportFigure(
            f"{drawn.stem}-causes", "Readable and used", "interventions",
            "Where a probe reads the answer, and how many episodes turn to the other side when the tokens of one "
            "layer are taken from the same inference with swapped images. Filled: significant over all layers. A "
            "layer that is readable and turns nothing is read by nothing behind it.",
            drawn.position, partial(site_effect_curve, drawn.run, drawn.results, drawn.results.settings.views[0]),
        )  # fmt: skip


# -- attention -----------------------------------------------------------------------------------------------

Percent = NDArray[np.float64]
Boxes = NDArray[np.float32]
_LABELS = {CORRECT: "correct picture's tile", OTHER: "other picture's tile", ACTION: "its own tokens"}


@dataclass(kw_only=True)
class AttentionDisplay(Display):
    """A curve by block of the backbone: the share of attention in percent that lies on one role's tokens.

    Descriptive: attended tokens need not be used, and no verdict reads this.

    Attributes:
        blocks: (B,) blocks that are read.
        roles: Names of the R roles; tiles are named by where the answer lies.
        mean: (R, B) means over iterations, heads and inferences.
        iterations: (R, B, I) means over heads and inferences.
        heads: (R, B, H) means over iterations and inferences.
    """

    measure: str = "% of attention (describes, no cause)"
    is_level: bool = True
    category: str
    blocks: NDArray[np.int64]
    roles: tuple[str, ...]
    mean: Percent
    iterations: Percent
    heads: Percent

    @classmethod
    def from_run(cls, run: RunReader, category: str, stored: Mapping[str, AttentionShares] | None = None) -> Self:
        """Read the newest attention that is stored of a category.

        Args:
            run: The run that stores the attention.
            category: The category that is drawn.
            stored: Result of `stored_attention`; None reads it from the run.

        Raises:
            NoInterventionsError: If there is none.
        """
        recorded = (stored_attention(run) if stored is None else stored).get(category)
        if recorded is None:
            raise NoInterventionsError(
                f"{run.location} has no stored attention of {category!r}. Run "
                f"`probe-kit intervene {as_argument(run.location)} --kind attention`"
            )
        left_out = {ALL, "special", *TILE_ROLES}
        by_block = recorded.frame(("block",))
        blocks = np.unique(by_block["block"].to_numpy(np.int64))
        # A role that no token plays has no row, such as a tile outside the scene.
        roles = tuple(role for role in dict.fromkeys(by_block["role"]) if role not in left_out)

        def shares(*by: Axis) -> Percent:
            frame = recorded.frame(("block", *by))
            table = frame.pivot_table(index=["role", "block"], columns=list(by) or None, values="share")
            return 100 * np.stack([table.loc[role].loc[blocks].to_numpy(float) for role in roles])

        return cls(
            title=title_of(category),
            category=category,
            blocks=blocks,
            roles=roles,
            mean=shares()[..., 0],
            iterations=shares("iteration"),
            heads=shares("head"),
            certificates=(ProvenanceLine.of_run(run),),
        )

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handles of the iterations' range and of the heads."""
        from matplotlib.lines import Line2D

        return [
            Line2D([], [], color="0.3", lw=3, alpha=0.25, label="wide bar: least to largest iteration"),
            Line2D([], [], color="0.3", ls="none", marker=".", ms=2.5, label="dot: one head"),
        ]

    def draw(self, axes: "Axes") -> None:
        """Draw a line for every role, with the range of its iterations and its heads around it."""
        for position, role in enumerate(self.roles):
            line, x = series(position), self.blocks + 0.06 * (position - len(self.roles) / 2)
            reach = np.nanmin(self.iterations[position], axis=1), np.nanmax(self.iterations[position], axis=1)
            axes.vlines(x, *reach, color=line.colour, lw=3, alpha=0.25)
            axes.plot(
                np.repeat(x, self.heads.shape[2]), self.heads[position].ravel(), ls="none", marker=".", ms=2.5,
                color=line.colour, alpha=0.6,
            )  # fmt: skip
            axes.plot(
                x, self.mean[position], color=line.colour, ls=line.dash, marker=line.marker, ms=5, mfc="white",
                lw=1.4, label=_LABELS.get(role, role),
            )  # fmt: skip
        layer_axis(axes, int(self.blocks.max()) + 1, label=False)
        axes.set_xlabel("block whose keys are read", fontsize=8.5)
        axes.set_ylim(bottom=0)


def attention_curve(run: RunReader) -> "Figure":
    """Return a figure with a panel per category of which attention is stored.

    Raises:
        NoInterventionsError: If there is none.
    """
    stored = stored_attention(run)
    return in_panels([AttentionDisplay.from_run(run, category, stored) for category in stored or ["any"]])


_HEAT = (1.0, 122 / 255, 0.0)
"""The colour of the viewer's overlay."""
_HEAVIEST = 0.8
"""Opacity of the strongest patch, as in the viewer."""


def attention_on_picture(run: RunReader, category: str | None = None) -> "Figure":
    """Draw an episode's first inference: the attention on each patch over the picture, of all blocks and of each.

    Means over heads and iterations; the strongest patch of a panel has the full colour. The first episode with a
    picture is drawn.

    Args:
        run: The run that stores attention on patches, and pictures.
        category: Category of the episode; None for the first one with stored patches.

    Raises:
        NoInterventionsError: If patches or pictures are not stored.
    """
    pictured = _first_pictured(run, category)
    if pictured is None:
        raise NoInterventionsError(
            f"{run.location} has no attention on patches{f' of {category!r}' if category else ''}, or no picture "
            f"to draw it on. Run `probe-kit intervene {as_argument(run.location)} --kind attention` on a run that "
            "stores pictures, with a family that says which token sees which pixels"
        )
    return _draw_on_picture(pictured, ProvenanceLine.of_run(run))


def _draw_on_picture(pictured: "_Pictured", certificate: ProvenanceLine) -> "Figure":
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    episode, picture, on_frame, weights = pictured
    read = [block for block in range(len(weights)) if not np.isnan(weights[block]).all()]
    maps = {"all blocks": weights[read].mean(axis=0), **{f"block {block}": weights[block] for block in read}}
    height, width = picture.shape[:2]
    figure, grid = panels(len(maps), 1.5, 1.5 * height / width + 0.25, columns=min(5, len(maps)))
    figure.set_figheight(figure.get_figheight() - 0.8)  # `panels` leaves room for a legend
    # matplotlib's pixels begin half a pixel before their number.
    boxes = on_frame * np.tile([width, height], 2) - 0.5
    visible = ~np.isnan(boxes).any(axis=1)
    for (title, values), axes in zip(maps.items(), grid, strict=True):
        axes.imshow(picture, interpolation="nearest")
        patches = [Rectangle((x, y), right - x, bottom - y) for x, y, right, bottom in boxes[visible]]
        strength = _HEAVIEST * values[visible] / max(values.max(initial=0.0), 1e-9)
        axes.add_collection(PatchCollection(patches, facecolors=[(*_HEAT, alpha) for alpha in strength], lw=0))
        axes.set_title(f"{title}: {100 * values.sum():.0f} %", fontsize=8, loc="left")
        axes.set_axis_off()
    caption(figure, certificate)
    figure.caption = f"episode {episode} · {figure.caption}"  # type: ignore[attr-defined]
    return figure


_Pictured = tuple[str, PictureArray, Boxes, Percent]
"""An episode: its id, its picture, (P, 4) boxes of patches and (B, P) shares of the attention."""


def _first_pictured(run: RunReader, category: str | None = None) -> _Pictured | None:
    """Return the first episode with attention and a picture."""
    stored = stored_patch_attention(run)
    patches = stored.get(category) if category is not None else next(iter(stored.values()), None)
    if patches is None:
        return None
    positions = {str(name): at for at, name in enumerate(run.episodes["episode_id"])}
    for row in np.argsort(patches.calls, kind="stable"):
        position, call = positions[str(patches.episodes[row])], int(patches.calls[row])
        if (frames := episode_frames(run, position)) is not None:
            # Interventions count inferences of an episode, and name frames of recordings by their number.
            inference = int(np.flatnonzero(run.control_steps[position] == call)[0]) if run.recorded else call
            picture = frames.decoded[inference if frames.kind == "inferences" else 0]
            on_frame = patches.on_frame(frames.cameras)
            return str(patches.episodes[row]), picture, on_frame.boxes, on_frame.weights[row].astype(np.float64)
    return None


@in_report(15, "sides", "labels")
def attention_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the figures of stored attention, once per run."""
    for drawn in {drawn.position: drawn for drawn in reversed(source.runs)}.values():
        if (pictured := _first_pictured(drawn.run)) is not None:
            yield ReportFigure(
                f"{drawn.stem}-attention-picture", "Attention on the picture", "interventions",
                "Where on the picture the acting stream's attention lies at one episode's first inference, by "
                "block, with the share of all attention. The strongest patch has the full colour. Descriptive: an "
                "attended patch need not be used, and no verdict reads this.",
                drawn.position, partial(_draw_on_picture, pictured, ProvenanceLine.of_run(drawn.run)),
            )  # fmt: skip
        if stored_attention(drawn.run):
            yield ReportFigure(
                f"{drawn.stem}-attention", "Attention by layer", "interventions",
                "How much of the attention that the acting stream pays lies on the pictures, the words and its "
                "own tokens, by the block whose keys are read. Dots: single heads; bars: from the least to the "
                "most of any iteration. Descriptive: attended tokens need not be used, and no verdict reads this.",
                drawn.position, partial(attention_curve, drawn.run), is_detail=True,
            )  # fmt: skip


@dataclass(kw_only=True)
class DoseResponseDisplay(Display):
    """A curve by coefficient: the share of episodes that turn to the target side, minus those that turn from it.

    Attributes:
        position: The place that was steered, such as `backbone.02 image`.
        coefficients: (K,) in the unit of the direction, ascending, 0 among them.
        net: (K,) percent of all episodes.
        net_left: (K,) percent of episodes that are pushed to the left, which may be saturated.
        net_right: (K,) percent of episodes that are pushed to the right, which may be saturated.
        controls: (C, K) percent of random directions of the same norm, NaN at a coefficient at which none was
            played.
        relative_change: (K,) distance by which tokens were moved, in their own norms; beyond two, an effect is
            little evidence.
        significant: (K,) whether the effect is beyond the controls, family-wise, and as large as the resolution.
        unit: The unit of the coefficients: half class-mean differences, or the vector of a file.
    """

    measure: str = "% of episodes that turn"
    panel_size: ClassVar = (3.1, 2.7)
    category: str
    position: str
    coefficients: NDArray[np.float64]
    net: Percent
    net_left: Percent
    net_right: Percent
    controls: Percent
    relative_change: NDArray[np.float64]
    significant: NDArray[np.bool_]
    unit: str = HALF_DIFFERENCE

    @classmethod
    def from_run(
        cls,
        run: RunReader,
        category: str,
        position: str | None = None,
        stored: Mapping[str, Mapping[str, Sequence[PatchEffect]]] | None = None,
    ) -> Self:
        """Read the steering that is stored of a category.

        Args:
            run: The run that stores the steering.
            category: The category that is drawn.
            position: One of several places, such as `backbone.02 image`; None for the first.
            stored: Result of `stored_steering`; None reads it from the run.

        Raises:
            NoInterventionsError: If there is none.
        """
        by_position = (stored_steering(run) if stored is None else stored).get(category, {})
        if not by_position or (position is not None and position not in by_position):
            alternatives = f"; it has it at {', '.join(by_position)}" if by_position else ""
            raise NoInterventionsError(
                f"{run.location} has no stored steering of {category!r}"
                f"{f' at {position}' if position else ''}{alternatives}. "
                f"Run `probe-kit intervene {as_argument(run.location)} --kind steer --sites backbone.NN "
                "--roles image`"
            )
        position = position or next(iter(by_position))
        rows = by_position[position]
        steered = sorted((row for row in rows if not row.is_control), key=lambda row: float(row.coefficient))
        coefficients = np.array([float(row.coefficient) for row in steered])
        names = dict.fromkeys(row.direction for row in rows if row.is_control)
        nets = {(row.direction, float(row.coefficient)): 100 * row.net for row in rows}
        return cls(
            title="\n".join([title_of(category), *position.split(", ")]),
            category=category,
            position=position,
            coefficients=coefficients,
            net=np.array([100 * row.net for row in steered]),
            net_left=np.array([100 * row.net_left for row in steered]),
            net_right=np.array([100 * row.net_right for row in steered]),
            controls=np.array(
                [[nets.get((name, coefficient), np.nan) for coefficient in coefficients] for name in names]
            ).reshape(len(names), len(coefficients)),
            relative_change=np.array([row.relative_change for row in steered]),
            significant=np.array([row.is_significant for row in steered], bool),
            unit=next((unit_of_doses(row.direction) for row in steered if row.is_dose), HALF_DIFFERENCE),
            certificates=(ProvenanceLine.of_run(run),),
        )

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handles of filled and open markers."""
        return significance_handles("more than random directions")

    def draw(self, axes: "Axes") -> None:
        """Draw a line for all episodes and one for either side, over the band of the controls."""
        axes.axhline(0, color="0.45", lw=1, ls=(0, (1, 1)))
        if self.controls.size:
            # Nothing was added at coefficient 0, by a control either.
            played = np.where(self.coefficients == 0, 0.0, self.controls)
            axes.fill_between(
                self.coefficients, played.min(axis=0), played.max(axis=0), color=GREY, alpha=0.35, lw=0,
                label="random directions of the same norm",
            )  # fmt: skip
        lines = {
            "all episodes": self.net,
            "pushed to the left": self.net_left,
            "pushed to the right": self.net_right,
        }
        for position, (label, percent) in enumerate(lines.items()):
            filled = self.significant if position == 0 else np.zeros(self.coefficients.size, bool)
            draw_series(axes, series(position), self.coefficients, percent, filled, label, 3.0 - 0.1 * position)
        ticks = zip(self.coefficients, self.relative_change, strict=True)
        axes.set_xticks(self.coefficients, [f"{coefficient:g}\n{_share(ratio)}" for coefficient, ratio in ticks])
        axes.set_ylim(-108, 108)
        axes.set_xlabel(f"{self.unit}\n%: of the tokens' own norm", fontsize=7.5)


def _share(ratio: float) -> str:
    """Return a ratio in percent with one or two digits that count, however small it is."""
    if 0 < ratio < 0.001:
        return "<0.1 %"
    return f"{100 * ratio:.2g} %" if ratio < 1 else f"{100 * ratio:.0f} %"


def dose_response(run: RunReader) -> "Figure":
    """Return a figure with a panel per category and place that was steered.

    Raises:
        NoInterventionsError: If none is stored.
    """
    stored = stored_steering(run)
    pairs: list[tuple[str, str | None]] = [
        (category, position) for category, by_position in stored.items() for position in by_position
    ]
    displays = [DoseResponseDisplay.from_run(run, *pair, stored) for pair in pairs or [("any", None)]]
    return in_panels(displays)


@in_report(14)
def dose_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield a figure per run that stores steering."""
    for drawn in source.runs:
        if stored_steering(drawn.run):
            yield ReportFigure(
                f"{drawn.stem}-doses", "How much of a direction turns the action", "interventions",
                "Episodes that turn to the side they are pushed to, minus those that turn from it, by how much of "
                "the direction is added; filled: beyond random directions of the same norm (the band). One side "
                "may be saturated, and beyond about two norms of the tokens any direction breaks the hand.",
                drawn.position, partial(dose_response, drawn.run),
            )  # fmt: skip


# -- knockouts ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CutCurve:
    """Losses by cuts of one role, by the layer at which their windows begin or end.

    Attributes:
        role: Role of the tokens that are cut.
        growth: `up to`: layers 0 to x are cut. `from`: x to the last. `around`: neighbours, x in the middle.
        layers: (K,) x, ascending.
        lost: (K,) share of the picture's effect in percent, or the change of the action in spreads.
        controls: (K,) the same of the controls; NaN without any.
        is_read: (K,) whether a cut loses more than its controls, family-wise, and enough to matter.
    """

    role: str
    growth: str
    layers: NDArray[np.float64]
    lost: NDArray[np.float64]
    controls: NDArray[np.float64]
    is_read: NDArray[np.bool_]


@dataclass(kw_only=True)
class KnockoutDisplay(Display):
    """A curve per role: the loss by the layers in which the acting part no longer reads its tokens.

    The band behind the curves marks the controls.

    Attributes:
        curves: One for every role and growth of windows.
        readable: Number of layers that could be cut.
    """

    measure: str = "lost % of the picture's effect"
    category: str
    curves: tuple[CutCurve, ...]
    readable: int

    @classmethod
    def from_run(
        cls, run: RunReader, category: str, stored: Mapping[str, Sequence[KnockoutEffect]] | None = None
    ) -> Self:
        """Read the knockout that is stored of a category.

        Args:
            run: The run that stores the knockout.
            category: The category that is drawn.
            stored: Result of `stored_knockouts`; None reads it from the run.

        Raises:
            NoInterventionsError: If there is none.
        """
        effects = (stored_knockouts(run) if stored is None else stored).get(category)
        if not effects:
            raise NoInterventionsError(
                f"{run.location} has no stored knockout of {category!r}. Run "
                f"`probe-kit intervene {as_argument(run.location)} --kind knockout`"
            )
        return cls(
            title=title_of(category),
            measure=measure_of_cuts(effects),
            category=category,
            curves=cut_curves(effects),
            readable=effects[0].readable,
            certificates=(ProvenanceLine.of_run(run),),
        )

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handles of filled and open markers."""
        return significance_handles("more than random tokens")

    def draw(self, axes: "Axes") -> None:
        """Draw a line for every role and growth, over the band of the controls of all of them."""
        axes.axhline(0, color="0.45", lw=1, ls=(0, (1, 1)))
        controls: dict[float, list[float]] = {}
        for curve in self.curves:
            for layer, control in zip(curve.layers, curve.controls, strict=True):
                if not np.isnan(control):
                    controls.setdefault(layer, [0.0]).append(control)
        if controls:
            layers = sorted(controls)
            axes.fill_between(
                layers, [min(controls[layer]) for layer in layers], [max(controls[layer]) for layer in layers],
                color=GREY, alpha=0.35, lw=0, label="as many random tokens of other roles",
            )  # fmt: skip
        roles = list(dict.fromkeys(curve.role for curve in self.curves))
        for curve in self.curves:
            line = replace(series(roles.index(curve.role)), dash="--" if curve.growth == "from" else "-")
            label = f"{curve.role}, {curve.growth} the layer"
            draw_series(axes, line, curve.layers, curve.lost, curve.is_read, label)
        layer_axis(axes, self.readable)


def measure_of_cuts(effects: Sequence[KnockoutEffect]) -> str:
    """Return the measure of the cuts of one category: the picture's effect, success, or the action's change."""
    if effects[0].is_of_success:
        return "lost success, % of episodes"
    if _are_shares(effects):
        return KnockoutDisplay.measure
    changed = "action" if effects[0].success is None else "cube's end"
    return f"change of the {changed}, in spreads"


def cut_curves(effects: Sequence[KnockoutEffect]) -> tuple[CutCurve, ...]:
    """Return a curve for every role and growth of windows, of the cuts of one category."""
    are_shares = _are_shares(effects)
    return tuple(
        _cut_curve(role, growth, rows, are_shares)
        for role, of_role in by_role(effects).items()
        for growth, rows in windows_by_growth(of_role).items()
    )


def _are_shares(effects: Sequence[KnockoutEffect]) -> bool:
    return any(row.lost is not None for row in effects)


def _layer_drawn(row: KnockoutEffect, growth: str) -> float:
    """Return the layer at which a cut is drawn: where its window ends, begins, or its middle."""
    ends = {"up to": row.last, "from": row.first}
    return float(ends.get(growth, (row.first + row.last) / 2))


def _cut_curve(role: str, growth: str, rows: Sequence[KnockoutEffect], are_shares: bool) -> CutCurve:
    rows = sorted(rows, key=lambda row: _layer_drawn(row, growth))
    lost = [row.lost if are_shares else row.size for row in rows]
    controls = [row.control_lost if are_shares else row.control_size for row in rows]
    factor = 100.0 if are_shares else 1.0
    return CutCurve(
        role,
        growth,
        layers=np.array([_layer_drawn(row, growth) for row in rows]),
        lost=factor * np.array(lost, np.float64),  # None becomes NaN
        controls=factor * np.array(controls, np.float64),
        is_read=np.array([row.matters for row in rows], bool),
    )


def knockout_curve(run: RunReader, stored: Mapping[str, Sequence[KnockoutEffect]] | None = None) -> "Figure":
    """Return a figure with a panel per category of which a knockout is stored.

    Args:
        run: The run that stores the knockouts.
        stored: Result of `stored_knockouts`; None reads it from the run.

    Raises:
        NoInterventionsError: If there is none.
    """
    stored = stored_knockouts(run) if stored is None else stored
    return in_panels([KnockoutDisplay.from_run(run, category, stored) for category in stored or ["any"]])


@in_report(15)
def knockout_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield a figure per run that stores a knockout."""
    for drawn in source.runs:
        if stored := stored_knockouts(drawn.run):
            yield ReportFigure(
                f"{drawn.stem}-knockout", "From which tokens the action reads", "interventions",
                "What is lost when the acting part cannot attend to the tokens of one role, by the layers in "
                "which they are cut: from the first up to this one, or from this one to the last. Filled: more "
                "than as many random tokens of other roles (the band). What other tokens of the backbone carried "
                "on is not cut.",
                drawn.position, partial(knockout_curve, drawn.run, stored),
            )  # fmt: skip
