"""A map of where the cube ended, over the tiles, seen from above."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.scoring import DEFAULT_RULE, Box, Disc, OutcomeRule, ReleasedOnTile, rule_of
from probe_kit.errors import UsageError
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.display import (
    GREEN,
    VERMILION,
    Display,
    ProvenanceLine,
    in_panels,
)
from probe_kit.retention.displays.report_figure import FigureSource, ReportFigure, in_report
from probe_kit.runs.reader import RunReader

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_OUTCOMES = {
    "correct": ("on the correct picture", GREEN, "o"),
    "wrong": ("on the wrong picture", VERMILION, "X"),
    "oob": ("on neither", "#595959", "."),
}
_MARGIN = 0.09  # metres of table around tiles and start
_MANY = 300  # points, above which a vector figure holds them as a picture


@dataclass(kw_only=True)
class FinalPositionsDisplay(Display):
    """Final places of the cube in metres: x away from the robot, y to its left.

    Attributes:
        category: None for all categories.
        xy: (E, 2), NaN where the simulator broke.
        outcome: (E,) `correct`, `wrong` or `oob`.
        never_moved: Number of episodes whose cube never left its start.
        scene: Tile places and sizes, zone radius and the start of the cube, as stored with the run.
        rule: The rule by which outcomes are judged.
    """

    category: str | None
    xy: NDArray[np.float64]
    outcome: NDArray[np.str_]
    never_moved: int
    scene: Mapping[str, Any]
    rule: str = DEFAULT_RULE
    panel_size: ClassVar = (3.1, 2.35)
    is_framed: ClassVar = True
    title_size: ClassVar = 10

    @classmethod
    def from_run(cls, run: RunReader, category: str | None = None, scene: Mapping[str, Any] | None = None) -> Self:
        """Read the episodes of a run, all of them or those of one category.

        Args:
            run: A run that stores its scene and the final positions.
            category: None for all.
            scene: Result of `SceneSpec.to_json()`; that of the run by default.

        Raises:
            UsageError: If the run has no scene or no positions, or no such category.
        """
        episodes: pd.DataFrame = run.episodes
        if category is not None:
            episodes = episodes[episodes["category"] == category]
        if episodes.empty:
            raise UsageError(f"{run.location} has no episodes of category {category!r}")
        scene = scene or run.settings.get("scene")
        if scene is None or not {"cube_x", "cube_y"} <= set(episodes):
            raise UsageError(
                f"{run.location} stores no scene or no final positions (cube_x, cube_y); runs of `extract` do"
            )
        unmoved = episodes["never_moved"].astype(bool).sum() if "never_moved" in episodes else 0
        return cls(
            title=title_of(category or "all categories"),
            figure_size=(4.6, 3.3),
            category=category,
            xy=episodes[["cube_x", "cube_y"]].to_numpy(dtype=float),
            outcome=episodes["outcome"].to_numpy(dtype=str),
            never_moved=int(unmoved),
            scene=scene,
            certificates=(ProvenanceLine.of_run(run),),
            rule=run.rule,
        )

    @property
    def counts(self) -> dict[str, int]:
        """Episodes by outcome."""
        return {name: int((self.outcome == name).sum()) for name in _OUTCOMES}

    def draw(self, axes: "Axes") -> None:
        """Draw tiles, zones, start and the final places."""
        rule = rule_of(self.rule, self.scene)
        low, high = _window(self.scene, _reach(rule))
        _draw_table(axes, self.scene, rule)
        inside = ((self.xy >= low) & (self.xy <= high)).all(axis=1)
        beyond = ~inside & np.isfinite(self.xy).all(axis=1)  # without positions where the simulator broke
        for name, (label, colour, marker) in _OUTCOMES.items():
            of_outcome = (self.outcome == name) & inside
            # y is to the robot's left, so that it is drawn to the reader's left.
            axes.scatter(
                -self.xy[of_outcome, 1], self.xy[of_outcome, 0], c=colour, marker=marker, label=label, s=18,
                alpha=0.65, linewidths=0, zorder=3, rasterized=bool(of_outcome.sum() > _MANY),
            )  # fmt: skip
        _set_window(axes, low, high, int(beyond.sum()))
        axes.set_xlabel(self._summary(), fontsize=7.5, color="0.3", labelpad=3)

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handle of the zones."""
        from matplotlib.lines import Line2D

        return [Line2D([], [], color="0.45", lw=0.8, ls="--", label="zone that counts")]

    def _summary(self) -> str:
        counts = self.counts
        unmoved = f" ({self.never_moved} unmoved)" if self.never_moved else ""
        return f"{counts['correct']} right · {counts['wrong']} wrong · {counts['oob']} out{unmoved}"


def final_positions(run: RunReader) -> "Figure":
    """Return a figure of the final places of the cube, a panel per category.

    Raises:
        UsageError: If the run stores none.
    """
    categories = [str(name) for name in run.episodes["category"].unique()]
    return in_panels([FinalPositionsDisplay.from_run(run, name) for name in categories])


def _reach(rule: OutcomeRule) -> float:
    """Return how far a zone reaches from the middle of its picture, in metres."""
    if isinstance(rule, Disc):
        return rule.radius
    assert isinstance(rule, Box | ReleasedOnTile)
    return rule.half


def _window(scene: Mapping[str, Any], zone: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners (x, y) of the part that is drawn."""
    reach = max(zone, scene["tile_side"] * 0.75)
    places = np.array([scene["tile_left"], scene["tile_right"], scene["cube_xy"]], float)
    margin = np.array([[reach], [reach], [_MARGIN]])
    return (places - margin).min(axis=0), (places + margin).max(axis=0)


def _draw_table(axes: "Axes", scene: Mapping[str, Any], rule: OutcomeRule) -> None:
    from matplotlib.patches import Circle, Rectangle

    turn = np.degrees(scene["tile_yaw"])
    for side in ("left", "right"):
        x, y = scene[f"tile_{side}"]
        half = scene["tile_side"] / 2
        corner = (-y - half, x - half)
        tile = Rectangle(
            corner, 2 * half, 2 * half, angle=turn, rotation_point="center", fc="0.95", ec="0.7", lw=0.8
        )
        axes.add_patch(tile)
        if isinstance(rule, Disc):
            axes.add_patch(Circle((-y, x), rule.radius, fill=False, ec="0.45", lw=0.8, ls="--"))
        else:
            reach, turned = _reach(rule), 0.0 if isinstance(rule, Box) else turn
            square = Rectangle(
                (-y - reach, x - reach), 2 * reach, 2 * reach, angle=turned, rotation_point="center", fill=False,
                ec="0.45", lw=0.8, ls="--",
            )  # fmt: skip
            axes.add_patch(square)
    x, y = scene["cube_xy"]
    half = scene["cube_side"] / 2
    start = Rectangle(
        (-y - half, x - half), 2 * half, 2 * half, angle=np.degrees(scene["cube_yaw"]), rotation_point="center",
        fill=False, ec="black", lw=0.9,
    )  # fmt: skip
    axes.add_patch(start)
    axes.text(-y, x - half - 0.008, "start", ha="center", va="top", fontsize=7)


def _set_window(axes: "Axes", low: NDArray[np.float64], high: NDArray[np.float64], outside: int) -> None:
    axes.set_xlim(-high[1], -low[1])
    axes.set_ylim(low[0], high[0])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_color("0.8")
    start, bottom = -high[1] + 0.012, low[0] + 0.012
    axes.plot([start, start + 0.1], [bottom, bottom], color="0.25", lw=1.5)
    axes.text(start + 0.05, bottom + 0.005, "10 cm", ha="center", va="bottom", fontsize=6.5, color="0.25")
    if outside:
        axes.text(-low[1] - 0.008, bottom, f"{outside} beyond the frame", ha="right", fontsize=6.5, color="0.25")


@in_report(8)
def position_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield a figure per run that stores final positions."""
    for drawn in source.runs:
        run = drawn.judged
        if run is None:
            continue
        if {"cube_x", "cube_y"} <= set(run.episodes) and run.settings.get("scene"):
            yield ReportFigure(
                f"{drawn.stem}-final-positions", "Where the cube ended", "behaviour",
                "The table from above, the robot below the picture. An episode counts as an answer if the middle "
                "of the cube ends inside a dashed line; “unmoved” means that the cube was never carried anywhere.",
                drawn.position, partial(final_positions, run), is_detail=True,
            )  # fmt: skip
