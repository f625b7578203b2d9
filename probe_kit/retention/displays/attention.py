"""Attention by block: how much attention the acting stream pays to the pictures, the words and itself."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NoInterventionsError
from probe_kit.intervene.kinds.attention import ACTION, CORRECT, OTHER, AttentionShares, Axis, stored_attention
from probe_kit.intervene.places import ALL, TILE_ROLES
from probe_kit.retention.columns.text import spell
from probe_kit.retention.displays.base.panels import Panelled, in_panels
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure
from probe_kit.retention.displays.base.style import layer_axis, series
from probe_kit.runs.reader import RunReader

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Percent = NDArray[np.float64]
_LABELS = {CORRECT: "correct picture's tile", OTHER: "other picture's tile", ACTION: "its own tokens"}


@dataclass
class AttentionDisplay(Panelled):
    """A curve by block of the backbone: the share of attention in percent that lies on one role's tokens.

    blocks: (B,) those that are read. roles: names of R; of tiles by where the answer lies. mean: (R, B) over
    iterations, heads and inferences. iterations: (R, B, I) over heads and inferences. heads: (R, B, H) over
    iterations and inferences. Descriptive: attended tokens need not be used, and no verdict reads this.
    """

    measure = "% of attention (describes, no cause)"
    category: str
    blocks: NDArray[np.int64]
    roles: tuple[str, ...]
    mean: Percent
    iterations: Percent
    heads: Percent
    certificate: ProvenanceLine
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_run(cls, run: RunReader, category: str) -> Self:
        """Read the newest attention that is stored of a category. Raises NoInterventionsError if there is none."""
        attention = stored_attention(run).get(category)
        if attention is None:
            raise NoInterventionsError(
                f"{run.location} has no stored attention of {category!r}. Run `probe-kit intervene {run.location} "
                "--kind attention`"
            )
        return cls._of(attention, category, ProvenanceLine.of_run(run))

    @classmethod
    def _of(cls, recorded: AttentionShares, category: str, certificate: ProvenanceLine) -> Self:
        left_out = {ALL, "special", *TILE_ROLES}
        blocks = np.unique(recorded.frame(("block",))["block"].to_numpy(np.int64))
        roles = tuple(role for role in recorded.shares() if role not in left_out)

        def shares(*by: Axis) -> Percent:
            frame = recorded.frame(("block", *by))
            table = frame.pivot_table(index=["role", "block"], columns=list(by) or None, values="share")
            return 100 * np.stack([table.loc[role].loc[blocks].to_numpy(float) for role in roles])

        return cls(
            category=category,
            blocks=blocks,
            roles=roles,
            mean=shares()[..., 0],
            iterations=shares("iteration"),
            heads=shares("head"),
            certificate=certificate,
        )

    @property
    def title(self) -> str:
        """The category."""
        return spell(self.category)

    def draw(self, axes: "Axes") -> None:
        """A line for every role, with what iterations and heads there are around it."""
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
    """A panel per category of which attention is stored. Raises NoInterventionsError if there is none."""
    displays = [
        AttentionDisplay._of(recorded, category, ProvenanceLine.of_run(run))
        for category, recorded in stored_attention(run).items()
    ]
    if not displays:
        AttentionDisplay.from_run(run, "any")
    return in_panels(displays)


PLACE = 15
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    for drawn in source.runs:
        if stored_attention(drawn.run):
            yield ReportFigure(
                f"{drawn.stem}-attention", "Attention by layer", "interventions",
                "How much of the attention that the acting stream pays lies on the pictures, the words and its "
                "own tokens, by the block whose keys are read. Dots: single heads; bars: from the least to the "
                "most of any iteration. Descriptive: attended tokens need not be used, and no verdict reads this.",
                drawn.position, partial(attention_curve, drawn.run), is_detail=True,
            )  # fmt: skip
