"""Attention by block: how much lies on pictures, words and the acting stream, and where on a picture."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NoInterventionsError
from probe_kit.intervene.kinds.attention import (
    ACTION,
    CORRECT,
    OTHER,
    AttentionShares,
    Axis,
    stored_attention,
    stored_patch_attention,
)
from probe_kit.intervene.places import ALL, TILE_ROLES
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.base.panels import Panelled, in_panels
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure
from probe_kit.retention.displays.base.style import caption, layer_axis, panels, series
from probe_kit.runs.reader import RunReader
from probe_kit.runs.thumbnails import episode_frames

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Percent = NDArray[np.float64]
Picture = NDArray[np.uint8]
Boxes = NDArray[np.float32]
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
        by_block = recorded.frame(("block",))
        blocks = np.unique(by_block["block"].to_numpy(np.int64))
        # A role that no token plays has no row, such as a tile outside the scene.
        roles = tuple(role for role in dict.fromkeys(by_block["role"]) if role not in left_out)

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
        return title_of(self.category)

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


_HEAT = (1.0, 122 / 255, 0.0)
"""The colour of the viewer's overlay."""
_HEAVIEST = 0.8
"""Opacity of the strongest patch, as in the viewer."""


def attention_on_picture(run: RunReader, category: str | None = None) -> "Figure":
    """An episode's first inference: the attention on each patch over the picture, of all blocks and of each.

    Means over heads and iterations; the strongest patch of a panel has the full colour. category: by default the
    first one with stored patches, of whose episodes the first one with a picture is drawn. Raises
    NoInterventionsError where patches or pictures are not stored.
    """
    pictured = _first_pictured(run, category)
    if pictured is None:
        raise NoInterventionsError(
            f"{run.location} has no attention on patches{f' of {category!r}' if category else ''}, or no picture "
            f"to draw it on. Run `probe-kit intervene {run.location} --kind attention` on a run that stores "
            "pictures, with a family that says which token sees which pixels"
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


_Pictured = tuple[str, Picture, Boxes, Percent]
"""An episode: its id, its picture, (P, 4) boxes of patches and (B, P) shares of the attention."""


def _first_pictured(run: RunReader, category: str | None = None) -> _Pictured | None:
    """The first episode with attention and a picture."""
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


PLACE = 15
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the figures that a report of these runs shows, once per run."""
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


label_figures = report_figures
