"""Probes of plain arrays, without a run, a model or a folder: `probe`."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit._system.table_cells import name_in
from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.array_run import ArrayRun
from probe_kit.train.choices import EVERYWHERE, Task
from probe_kit.train.probe_sweep import train_probes
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults, exceeds_column
from probe_kit.train.target import Target

if TYPE_CHECKING:
    import pandas as pd


# -- probes of arrays ----------------------------------------------------------------------------------------

Sites = ArrayLike | Mapping[str, ArrayLike]
"""Features of one site (N, D), of several (S, N, D), or by name."""
VIEW, STREAM = "mean", "backbone"  # a stream of any other name would need a part
_OF_RUNS = (
    "model", "random_weights", "target", "category", "view", "site", "stream", "part", "layer", "depth",
    "iteration", "episodes", "items", "settings",
)  # fmt: skip
"""Columns of scores that arrays do not have."""


@dataclass(frozen=True, repr=False)
class ArrayProbes:
    """The probes of plain arrays, as `probe` returns them.

    Attributes:
        names: Names of the S sites, in order.
        results: The scores, controls and directions, as `train_probes` returns them.
        order: (N,) the row of X that each sample of `results` is.
        classes: Values of y in the order of their codes; empty for quantities.
    """

    names: tuple[str, ...]
    results: ProbeResults
    order: NDArray[np.intp]
    classes: NDArray[Any]

    @cached_property
    def scores(self) -> "pd.DataFrame":
        """Return one row per site, by name; the columns are those of `ProbeResults.scores`."""
        scores = self.results.scores.drop(columns=list(_OF_RUNS))
        scores.index = list(self.names)
        return scores.rename_axis("site")

    @property
    def best(self) -> str:
        """The site whose score exceeds its chance most; its score is too high by the luck of being chosen."""
        return self.names[self._curve.largest_excess(np.arange(len(self.names)))]

    @property
    def _curve(self) -> ProbeCurve:
        return self.results.curves[EVERYWHERE, VIEW]

    @property
    def predictions(self) -> NDArray[Any]:
        """The held-out predictions (S, N) in the order of X: values of y, or quantities."""
        codes = np.empty_like(self._curve.decisions)
        codes[:, self.order] = self._curve.decisions
        return self.classes[codes.astype(int)] if self.classes.size else codes

    @property
    def fold_of(self) -> NDArray[np.int64]:
        """The number of the outer fold in which each row of X was held out, (N,)."""
        fold_of = np.empty_like(self._curve.fold_of)
        fold_of[self.order] = self._curve.fold_of
        return fold_of

    @property
    def null(self) -> NDArray[np.float64]:
        """The scores (S, P) of every site with every permutation of the labels."""
        return self._curve.null

    def __repr__(self) -> str:
        row = self.scores.loc[self.best]
        p = "no p" if row["p_fwe"] != row["p_fwe"] else f"p {row['p_fwe']:.3f}"
        missed = [name for name in self.results.controls.names if not row[exceeds_column(name)]]
        limits = f"[{row['ci_low']:.3f}, {row['ci_high']:.3f}]"
        parts = [
            f"<ArrayProbes of {len(self.names)} sites, {row['n']} samples in {row['groups']} groups:",
            f"best {self.best} with {row['metric']} {row['score']:.3f} {limits}, chance {row['chance']:.3f}, {p}"
            + f"; not shown to exceed {', '.join(missed)}" * bool(missed)
            + "; .scores has every site>",
        ]
        return " ".join(parts)


def probe(
    X: Sites,
    y: ArrayLike,
    groups: ArrayLike | None = None,
    *,
    task: Task | None = None,
    controls: Mapping[str, ArrayLike] | None = None,
    untrained: Sites | None = None,
    strata: ArrayLike | None = None,
    ordered: bool = False,
    permutations: int = 200,
    seed: int = 0,
    jobs: int | None = None,
) -> ArrayProbes:
    """Probe arrays: at which site can `y` be decoded, beyond chance and beyond controls?

    The score is balanced accuracy or R² of held-out groups, with nested folds. Nothing is stored.

    Args:
        X: (N, D) features of one site, (S, N, D) of several, or a dictionary from names to (N, D).
        y: (N,) labels: two values, classes as texts, or quantities.
        groups: (N,) units that folds, intervals and label permutations keep together, such as a subject or a
            picture; by default every sample is a group.
        task: `binary`, `classes` or `continuous`; needed only where the values leave a doubt.
        controls: Features (N, D) by name that never saw the model; a signal must exceed each of them.
        untrained: The same sites of an untrained network; a signal must exceed the best of them.
        strata: (N,) values within which label permutations exchange groups; by default groups exchange everywhere.
        ordered: Whether the samples of every group come in an order that corresponds between groups, such as time;
            permutations then keep it.
        permutations: Number of label permutations behind the p-values, as in `train_probes`, which fits the
            probes.
        seed: Seed of folds and permutations, as in `train_probes`, and of the order of the samples.
        jobs: Number of processes, as in `train_probes`; None for this process alone.

    Raises:
        UsageError: For arrays that do not fit together or hold NaN or infinity, and for labels without a task.
        TooFewGroupsError: For fewer than five groups with each class.
    """
    import pandas as pd

    sites = _sites(X, "X")
    count = len(next(iter(sites.values())))
    names = [f"{number:09d}" for number in range(count)]
    order: NDArray[np.intp] = np.arange(count)
    if not ordered:
        order = np.random.default_rng(derive_seed("array order", seed)).permutation(count)
    labels = _column(y, count, "y")
    columns: dict[str, list[Any]] = {"episode_id": names, "y": [labels[row] for row in order]}
    group_of = names if groups is None else list(map(name_in, _column(groups, count, "groups")))
    columns["group_id"] = [group_of[row] for row in order]
    if strata is not None:
        texts = list(map(name_in, _column(strata, count, "strata")))
        columns["strata"] = [texts[row] for row in order]
    table = pd.DataFrame(columns)
    episodes = table[["episode_id", "group_id"]].assign(category=EVERYWHERE)
    networks = {"arrays": sites}
    if untrained is not None:
        networks["untrained"] = _sites(untrained, "untrained", count)
    reserved = ("chance", "untrained", "random-features")
    if wrong := [name for name in controls or {} if not isinstance(name, str) or not name or name in reserved]:
        raise UsageError(f"a control is called {wrong[0]!r}; expected a text other than {', '.join(reserved)}")
    of_controls = {
        name: _matrix(array, f"controls[{name!r}]", count)[order] for name, array in (controls or {}).items()
    }
    with tempfile.TemporaryDirectory(prefix="probe-kit-") as folder:
        runs = {
            model: ArrayRun(
                Path(folder) / model,
                model=model,
                suite="arrays@1#0",
                episodes=episodes,
                features={
                    (Site(STREAM, layer), VIEW): array[order] for layer, array in enumerate(site_arrays.values())
                },
                control_features=of_controls if model == "arrays" else {},
            )
            for model, site_arrays in networks.items()
        }
        target = Target.read(table, "y", task, exchange_within=None if strata is None else "strata")
        results = train_probes(
            runs["arrays"],
            target=target,
            views=(VIEW,),
            permutations=permutations,
            controls=tuple(controls or ()),
            untrained=runs.get("untrained"),
            seed=seed,
            jobs=jobs,
        )
    values: NDArray[Any] = np.empty(0)
    if target.coded.classes:
        # Of each class the value in its first row: texts that spell numbers are sorted as numbers.
        _, first = np.unique(target.coded.values, return_index=True)
        values = np.asarray([labels[order[row]] for row in first])
    return ArrayProbes(tuple(sites), results, order, values)


def _sites(arrays: Sites, what: str, count: int | None = None) -> dict[str, NDArray[np.float32]]:
    """Return the features (N, D) by the name of their site."""
    if isinstance(arrays, Mapping):
        by_name = {str(name): array for name, array in arrays.items()}
    else:
        array = np.asarray(arrays)
        if array.ndim not in (2, 3):
            raise UsageError(
                f"{what} has the shape {array.shape}; expected (N, D) of one site or (S, N, D) of several"
            )
        by_name = {
            str(number): site_array for number, site_array in enumerate(array if array.ndim == 3 else array[None])
        }
    if not by_name:
        raise UsageError(f"{what} holds no site; expected one or more")
    sites: dict[str, NDArray[np.float32]] = {}
    for name, site_array in by_name.items():
        sites[name] = _matrix(site_array, f"site {name!r} of {what}" if len(by_name) > 1 else what, count)
        count = len(sites[name])
    return sites


def _matrix(features: ArrayLike, what: str, count: int | None) -> NDArray[np.float32]:
    """Return the features as (N, D) finite float32.

    Raises:
        UsageError: For no numbers, another shape than (N, D) or (`count`, D), NaN and infinity.
    """
    try:
        array = np.asarray(features, np.float32)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{what} holds no numbers ({error}); expected (N, D) floats") from None
    if array.ndim != 2 or 0 in array.shape or (count is not None and len(array) != count):
        rows = "N" if count is None else str(count)
        raise UsageError(f"{what} has the shape {array.shape}; expected ({rows}, D), a row per sample")
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise UsageError(f"{what} holds NaN or infinity in row {row}; leave the sample out, or correct it")
    return array


def _column(column: ArrayLike | Sequence[Any], count: int, what: str) -> list[Any]:
    """Return a column as a list of `count` values.

    Raises:
        UsageError: For another number of values, and for missing ones.
    """
    array = np.asarray(column)
    if array.shape != (count,):
        raise UsageError(f"{what} has the shape {array.shape}; expected ({count},), one value per row of X")
    # Not those of the array where it took numbers for texts: 7 and 7.5 beside each other become decimals.
    values: list[Any] = list(column) if isinstance(column, Sequence) else array.tolist()
    values = [value.item() if isinstance(value, np.generic) else value for value in values]
    if missing := [row for row, value in enumerate(values) if value is None or value != value]:
        raise UsageError(f"{what} has no value in row {missing[0]}; leave the sample out of X, y and groups")
    return values
