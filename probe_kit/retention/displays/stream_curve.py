"""The numbers of a layer curve: one stream's score by layer, as a line per iteration or the best of them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.choices import Iterations
from probe_kit.retention.displays.base.selection import of_iterations
from probe_kit.train.choices import SIDES

if TYPE_CHECKING:
    import pandas as pd

Shares = NDArray[np.float64]


@dataclass(frozen=True)
class LayerLine:
    """Held-out score by layer; arrays (L,), accuracies as shares or R², with their 95 % interval over groups.

    iteration: of all values, None where the stream runs once or where every layer has its best one.
    significant: above chance, family-wise, and above the controls that were run.
    """

    iteration: int | None
    layers: NDArray[np.int64]
    score: Shares
    low: Shares
    high: Shares
    significant: NDArray[np.bool_]

    @classmethod
    def of(cls, rows: "pd.DataFrame", iteration: int | None = None) -> Self:
        """Read rows of `ProbeResults.scores`, one per layer."""
        rows = rows.sort_values("layer")
        score, low, high = (rows[name].to_numpy(dtype=float) for name in ("score", "ci_low", "ci_high"))
        significant = rows["signal"].to_numpy(dtype=bool)
        return cls(iteration, rows["layer"].to_numpy(dtype=np.int64), score, low, high, significant)


@dataclass(frozen=True)
class StreamCurve:
    """One stream's held-out score by layer; arrays (L,), accuracies as shares or R².

    part: of the model, see `Stream.part`. depth: the layer as a fraction.

    sites: L best ones of the iterations that are shown, of a label by the score above their own chance. score: of
    these, with its 95 % interval `low`, `high` over groups. least, most: over these iterations. significant: above
    chance, family-wise, and above the controls that were run. iterations: how many are shown.
    lines: what is drawn: one per iteration, or the best. peaks: (layer, iteration) of the best sites, all of them
    where several tie.
    """

    stream: str
    part: str
    sites: tuple[str, ...]
    layers: NDArray[np.int64]
    depth: Shares
    score: Shares
    low: Shares
    high: Shares
    least: Shares
    most: Shares
    significant: NDArray[np.bool_]
    iterations: int
    lines: tuple[LayerLine, ...]
    peaks: tuple[tuple[int, int | None], ...]

    @classmethod
    def of(cls, scores: "pd.DataFrame", iterations: Iterations = "best") -> Self:
        """Read the rows of one category, view and stream of `ProbeResults.scores`.

        Raises UsageError if the stream has no such iteration.
        """
        scores = of_iterations(scores, iterations)
        by_layer = scores.groupby("layer")["score"]
        excess = scores["score"] - (0.0 if scores["target"].iloc[0] in SIDES else scores["chance"].fillna(0.0))
        best_rows = scores.loc[excess.groupby(scores["layer"]).idxmax()].sort_values("layer")
        best = LayerLine.of(best_rows)
        steps = sorted(int(step) for step in scores["iteration"].dropna().unique())
        each = tuple(LayerLine.of(scores[scores["iteration"] == step], step) for step in steps)
        tied = scores[excess >= excess.max() - 1e-12]  # equal but for rounding of sums
        return cls(
            stream=str(scores["stream"].iloc[0]),
            part=str(scores["part"].iloc[0]),
            sites=tuple(best_rows["site"]),
            layers=best.layers,
            depth=best_rows["depth"].to_numpy(dtype=float),
            score=best.score,
            low=best.low,
            high=best.high,
            least=by_layer.min().to_numpy(dtype=float),
            most=by_layer.max().to_numpy(dtype=float),
            significant=best.significant,
            iterations=len(steps) or 1,
            lines=each if each and iterations != "best" else (best,),
            peaks=tuple(
                (int(layer), None if np.isnan(step) else int(step))
                for layer, step in zip(tied["layer"], tied["iteration"].astype("float64"), strict=True)
            ),
        )

    @property
    def name(self) -> str:
        """Return the name that people call the stream."""
        return label_of(self.stream)

    @property
    def label(self) -> str:
        """The name, and which iterations are shown if not all are."""
        if self.iterations > 1:
            return f"{self.name}, best iteration" if len(self.lines) == 1 else self.name
        step = self.lines[0].iteration
        return self.name if step is None else f"{self.name}, iteration {step}"
