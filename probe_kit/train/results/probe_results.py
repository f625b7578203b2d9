"""Probe results: settings, directions, the table of scores with its best sites, and the decisions behind it."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import UNREADABLE, open_arrays
from probe_kit._system.types import Matrix
from probe_kit._tables.numbers import number, p_text, percent
from probe_kit._tables.table import Cell, Legend, Table
from probe_kit.errors import UnknownSiteError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.sites import Site, label_of
from probe_kit.runs.direction_files import about_direction, write_directions
from probe_kit.runs.reader import RunReader
from probe_kit.runs.results import Bundle, axes_problem, fields_problem
from probe_kit.statistics.folds import FoldUnit
from probe_kit.statistics.label_permutations import p_value, permutations_for, shortage
from probe_kit.statistics.share_limits import wilson_limits
from probe_kit.train.choices import EVERYWHERE, SIDES, Incomplete, Task
from probe_kit.train.crossval.task_scores import METRICS, fold_auc, fold_spearman, log_loss
from probe_kit.train.results.control_scores import Controls, has_signal
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.samples import is_token_view

if TYPE_CHECKING:
    import pandas as pd
    from numpy.lib.npyio import NpzFile


FORMAT = 8  # raise when settings have other fields or would give other numbers


@dataclass(frozen=True)
class ProbeSettings:
    """The settings that decide the numbers; their hash is the results' key.

    Attributes:
        weights: sha256 of the network's weights; None where the run does not name it.
        seed_text: Text of the run that seeds random draws, see `RunReader`; scores on equal groups of one text are
            paired.
        episodes: sha256 of the ids of the run's episodes, so that a run that grew is probed again.
        token_permutations: Number of permutations of token views; 0 where none is probed.
        call: Captured inference that a label of a whole episode is decoded from.
        label: sha256 of the labels of the target.
        group_by: Column of the groups.
        exchange_within: Column of the strata, empty for exchanges everywhere.
        grouping: sha256 of groups and strata, empty for a side.
        window: Inferences per episode.
        align_to: Column of the event where windows begin, `#` and a part of its hash; empty for the first
            inference.
    """

    model: str
    random_weights: bool
    weights: str | None
    suite: str
    seed_text: str
    run_settings: str
    episodes: str
    categories: tuple[str, ...]
    views: tuple[str, ...]
    target: str
    permutations: int
    seed: int
    token_permutations: int = 0
    folds: FoldUnit = "groups"
    incomplete: Incomplete = "keep"
    call: int = 0
    task: Task = "binary"
    label: str = ""
    group_by: str = "group_id"
    exchange_within: str = ""
    grouping: str = ""
    window: int = 1
    align_to: str = ""
    format: int = FORMAT

    @property
    def key(self) -> str:
        """The first 12 hex digits of the settings' sha256: the name of the results' folder."""
        return sha256_json(asdict(self))[:12]

    @property
    def balanced(self) -> bool:
        """Whether accuracies are balanced between two sides of a picture, see `Target.balanced`."""
        return self.target in SIDES

    @property
    def write_score(self) -> Callable[[float | None], str]:
        """The function that writes a score: an accuracy of a side in percent, others as they are."""
        return percent if self.balanced else three_digits


# -- directions ----------------------------------------------------------------------------------------------

Place = tuple[str, str, Site]
"""A category, a view and a site."""


_AXES = {"weights": "f FD", "intercepts": "f F", "spreads": "f F"}
"""The types and axes of the arrays of a direction, see `axes_problem`."""


@dataclass(frozen=True)
class Direction:
    """The probes of one place in raw features: w · x + b > 0 reads `left`, one probe per outer fold (F).

    Each fold's probe never saw the episodes that the fold tests (`ProbeCurve.fold_of`). To steer an episode
    without having trained on it, take its fold's row.

    Attributes:
        weights: (F, D) float32 weights w.
        intercepts: (F,) intercepts b.
        spreads: (F,) deviation of the training samples along weights / ‖weights‖, the σ of a steering strength.
    """

    weights: NDArray[np.float32]
    intercepts: NDArray[np.float64]
    spreads: NDArray[np.float64]

    @property
    def unit(self) -> NDArray[np.float64]:
        """The mean of the folds' unit weights, (D,), of length 1; zero where no probe has any weight."""
        lengths = np.linalg.norm(self.weights, axis=1, keepdims=True)
        mean = np.divide(self.weights, lengths, where=lengths > 0, out=np.zeros(self.weights.shape)).mean(axis=0)
        length = np.linalg.norm(mean)
        return np.asarray(mean / length if length else mean)

    @property
    def spread(self) -> float:
        """The mean of `spreads`."""
        return float(self.spreads.mean())


def save_directions(directions: Mapping[Place, Direction], file: BinaryIO) -> None:
    """Write directions to an uncompressed `.npz`, with the members `category/view/site/part`.

    Views and sites hold no slash.
    """
    arrays = {
        f"{category}/{view}/{site}/{part}": array
        for (category, view, site), direction in directions.items()
        for part, array in vars(direction).items()
    }
    np.savez(file, allow_pickle=False, **arrays)


class StoredDirections(Mapping[Place, Direction]):
    """The directions in a file of stored results, each read when it is asked for.

    All of the file is checked once, before the first one is read. A changed file raises RunDamagedError then.
    """

    def __init__(self, bundle: Bundle, name: str) -> None:
        self._bundle, self._name = bundle, name
        self._checked = False

    def _open(self) -> BinaryIO:
        if not self._checked:
            self._bundle.check(self._name)
            self._checked = True
        return self._bundle.open(self._name)

    @contextmanager
    def _arrays(self) -> Iterator["NpzFile"]:
        """Open the file. A file, or an array in it, that cannot be read raises RunDamagedError."""
        with self._open() as file:
            try:
                with open_arrays(file) as arrays:
                    yield arrays
            except KeyError:  # a place that was not probed
                raise
            except UNREADABLE as error:
                raise self._bundle.damaged(self._name, f"cannot be read: {error}") from error

    def __getitem__(self, key: Place) -> Direction:
        return self.read([key])[key]

    def read(self, places: Iterable[Place]) -> dict[Place, Direction]:
        """Return several directions in one opening of the file.

        Raises:
            KeyError: For a place that was not probed.
        """
        directions = {}
        with self._arrays() as arrays:
            for key in places:
                name = "/".join(map(str, key))
                if f"{name}/weights" not in arrays:
                    raise KeyError(key)
                parts = {
                    part.name: arrays[f"{name}/{part.name}"]
                    for part in fields(Direction)
                    if f"{name}/{part.name}" in arrays
                }
                if problem := fields_problem(Direction, parts) or axes_problem(_AXES, parts):
                    raise self._bundle.damaged(self._name, f"{problem} ({name})")
                directions[key] = Direction(**parts)
        return directions

    def __iter__(self) -> Iterator[Place]:
        with self._arrays() as arrays:
            for name in dict.fromkeys(member.rpartition("/")[0] for member in arrays):
                category, view, site = name.rsplit("/", 2)
                yield category, view, Site.parse(site)

    def __len__(self) -> int:
        return sum(1 for _ in self)


def read_directions(directions: Mapping[Place, Direction], places: Iterable[Place]) -> dict[Place, Direction]:
    """Return the directions of `places`, stored ones in one opening of their file.

    Raises:
        KeyError: For a place that was not probed.
    """
    if isinstance(directions, StoredDirections):
        return directions.read(places)
    return {key: directions[key] for key in places}


def write_direction_file(directions: Mapping[Place, Direction], file: Path, weights: str | None) -> int:
    """Write the probes' directions for `intervene --direction FILE#NAME`, and return how many.

    A vector is the mean of the folds' unit weights, times the deviation of the samples along it: a coefficient
    counts deviations, toward `left`. Probes without any weight are left out.

    Args:
        directions: Probes of a side, by category, view and site.
        file: Safetensors or npz file to write.
        weights: Hash of the network's weights, which is stored with each vector.
    """
    vectors, about = {}, {}
    for (category, view, site), direction in read_directions(directions, directions).items():
        if direction.unit.any():
            name, about_name = about_direction(category, view, site, weights)
            vectors[name] = direction.unit * direction.spread
            about[name] = about_name
    write_directions(file, vectors, about)
    return len(vectors)


# -- the table of scores -------------------------------------------------------------------------------------


def score_rows(
    settings: ProbeSettings, controls: Controls, key: tuple[str, str], curve: ProbeCurve
) -> Iterator[dict[str, Any]]:
    """Yield the row of every site of a curve, see `ProbeResults.scores`.

    Args:
        settings: Settings of the probes.
        controls: Controls with which the sites are compared.
        key: Category and view of the curve.
        curve: Probes of the sites.
    """
    category, view = key
    score, low, high = _estimates(curve)
    p, p_fwe, chance = p_value(curve.metric, curve.null), curve.p_fwe(), curve.chance
    for row, (site, part) in enumerate(zip(curve.sites, curve.parts, strict=True)):
        exceeds = {
            name: better
            for name, better in controls.exceeds(*key, site, float(p_fwe[row])).items()
            if curve.balanced or name == "chance" or better is not None
        }
        yield {
            "model": settings.model,
            "random_weights": settings.random_weights,
            "target": settings.target,
            "task": curve.task,
            "category": category,
            "view": view,
            "site": str(site),
            "stream": site.stream,
            "part": part,
            "layer": site.layer,
            "depth": curve.depth(site),
            "iteration": site.iteration,
            "metric": METRICS[curve.task],
            "score": score[row],
            "ci_low": low[row],
            "ci_high": high[row],
            "chance": chance[row],
            "p": p[row],
            "p_fwe": p_fwe[row],
            "smallest_p": curve.least_p,
            **{exceeds_column(name): better for name, better in exceeds.items() if name != "chance"},
            "signal": has_signal(exceeds),
            **(_side_row(curve, row, score[row]) if curve.balanced else _label_row(controls, key, curve, row)),
            "n": curve.labels.size,
            "episodes": np.unique(curve.episodes).size,
            "items": np.unique(curve.items).size,
            "groups": curve.n_groups,
            "settings": settings.key,
        }


def exceeds_column(control: str) -> str:
    """Return the name of the column that says whether a site exceeds a control."""
    return f"exceeds_{control.replace('-', '_')}"


def _estimates(curve: ProbeCurve) -> tuple[Matrix, Matrix, Matrix]:
    """Return the scores (S,) with the lower and upper ends of their intervals."""
    if curve.balanced:
        sums = curve.sums
        return sums.accuracies, *wilson_limits(sums.sums, sums.sizes)
    limits = np.array([curve.estimate(np.array([row]))[1] for row in range(len(curve.sites))])
    return curve.metric, limits[:, 0], limits[:, 1]


def _side_row(curve: ProbeCurve, row: int, accuracy: float) -> dict[str, Any]:
    correct, control = curve.correct[row], curve.control_accuracy[row]
    return {
        "accuracy": accuracy,
        "auc": fold_auc(curve.decisions[row], curve.labels, curve.folds()),
        "log_loss": float(log_loss(curve.decisions[row], curve.labels)),
        "control_accuracy": control,
        "selectivity": curve.metric[row] - control,
        "C": " ".join(f"{strength:g}" for strength in curve.strengths[row]),
        "fold_accuracy": " ".join(f"{correct[fold.test].mean():.4f}" for fold in curve.folds()),
    }


def _label_row(controls: Controls, key: tuple[str, str], curve: ProbeCurve, row: int) -> dict[str, Any]:
    quantity = curve.task == "continuous"
    return {
        "spearman": fold_spearman(curve.decisions[row], curve.labels, curve.folds()) if quantity else float("nan"),
        "best_control": controls.reference(*key, curve.sites[row]),
        "penalties": " ".join(f"{penalty:g}" for penalty in curve.penalties[row]),
    }


def best_sites(scores: "pd.DataFrame") -> "list[pd.Series]":
    """Return the best site of every category, view and stream: a row of `ProbeResults.scores`, by category.

    The best site has the largest excess over its own chance, which is one half for a side; the first on ties.
    There are two columns besides those of `scores`. `ties` is how many other sites are as good. `first` is the
    best score at the stream's first iteration, NaN where it runs once.
    """
    names = ["category", "view", "stream"]
    worth = scores["score"] - scores["chance"].fillna(0.0)
    by_stream = worth.groupby([scores[name] for name in names], sort=False)
    iterations = scores["iteration"].groupby([scores[name] for name in names], sort=False)
    begins = scores["iteration"].eq(iterations.transform("min")).fillna(False).astype(bool)
    marked = scores.assign(ties=worth == by_stream.transform("max"), first=scores["score"].where(begins))
    grouped = marked.groupby(names, sort=False)
    marked = marked.assign(ties=grouped["ties"].transform("sum") - 1, first=grouped["first"].transform("max"))
    best = marked.loc[by_stream.idxmax()].sort_values("category", kind="stable")
    return [row for _, row in best.iterrows()]


def site_cells(row: "pd.Series", write: Callable[[float | None], str]) -> tuple[Cell, Cell, Cell, Cell]:
    """Return a row of `best_sites`: the site with its ties, score, chance and p; a dash for none.

    Args:
        row: A row of `best_sites`.
        write: Function that writes a score, see `ProbeSettings.write_score`.
    """
    site = Cell(str(row["site"]), after=f" +{row['ties']}" if row["ties"] else "")
    score = Cell(row["score"], write, (row["ci_low"], row["ci_high"]))
    return site, score, Cell(row["chance"], write), Cell(row["p_fwe"], p_text)


def three_digits(value: float | None) -> str:
    """Return a number with three digits; a dash for none."""
    return number(value, 3)


# -- all results ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, repr=False)
class ProbeResults:
    """The probes of one target in one run under one set of settings.

    Attributes:
        curves: Curves by (category, view).
        directions: Weights of the probes of a side by (category, view, site); empty for other targets.
        controls: Controls with which the probes are compared, as far as requested.
        created: Time when they were fitted (UTC, ISO 8601); not part of the key.
        stamp: Hash of the commits they were fitted to, empty for arrays in memory.
        label: Name of the run in tables, by default its model; not part of the key either.
        left_out: Number of episodes and inferences that have no part in any category, by reason.
        conditions: Number of probed episodes by condition of a served run; empty for a run without conditions.
    """

    settings: ProbeSettings
    curves: Mapping[tuple[str, str], ProbeCurve]
    directions: Mapping[Place, Direction] = field(default_factory=dict)
    controls: Controls = field(default_factory=Controls)
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="microseconds"))
    stamp: str = ""
    label: str = ""
    left_out: Mapping[str, int] = field(default_factory=dict)
    conditions: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "label", self.label or self.settings.model)

    def remedy(self, category: str, view: str, tests: int = 1) -> str:
        """Return what to do where no p of a view can be below the level; empty where one can.

        Args:
            category: Category of the curve.
            view: View of the curve.
            tests: Number of tests that p is corrected for.
        """
        settings, is_token = self.settings, is_token_view(view)
        permutations = settings.token_permutations if is_token else settings.permutations
        match shortage(self.curves[category, view].least_p, permutations, tests):
            case "permutations":
                return f"train with --{'token-' * is_token}permutations {permutations_for(tests)} or more"
            case "groups":
                if self.curves[category, view].least_p >= 1:
                    return "take groups in which the label differs"
                return "extract more items" if settings.balanced else "label more groups"
        return ""

    def __repr__(self) -> str:
        settings = self.settings
        random = ", RANDOM WEIGHTS" if settings.random_weights else ""
        task = "" if settings.balanced else f" ({settings.task})"
        return (
            f"<ProbeResults {settings.key} of {self.label}{random}: {', '.join(settings.categories)}; "
            f"views {', '.join(settings.views)}; target {settings.target}{task}; call {settings.call}; "
            f"{settings.permutations} label permutations>"
        )

    def _repr_html_(self) -> str:
        return best_sites_table([self])._repr_html_()

    @property
    def key(self) -> str:
        """The hash of the settings."""
        return self.settings.key

    @cached_property
    def scores(self) -> "pd.DataFrame":
        """The scores with one row per category, view and site.

        `score` is the metric that the column `metric` names, with its 95 % interval over groups (`ci_low`,
        `ci_high`); that of a side is called `accuracy` too. `chance`: one half for a side, else the mean score of
        the label permutations at this site. `p` of the site alone, `p_fwe` against the best of the stream: the
        most accurate site of a side, else the largest excess over chance. `smallest_p`: no p-value can be lower
        with so many label permutations. `depth`: the layer as a fraction. `exceeds_NAME`: whether the site exceeds
        that control; of a side `exceeds_random_features` and `exceeds_untrained`, missing where they were not run.
        `signal`: better than chance, family-wise, and than every control that sites were compared with. `n`:
        samples.

        A side also has `C` and `fold_accuracy` per outer fold, `auc`, `log_loss`, `control_accuracy` and
        `selectivity`. `control_accuracy` is the mean accuracy of the same probe on random labels that are
        consistent within a group, and `selectivity` the accuracy above it; both are NaN without label
        permutations. Other targets have `penalties` per outer fold (λ, or 1 / C) and `best_control`, the score of
        the best control. A quantity has `spearman`, Spearman's ρ within folds.
        """
        import pandas as pd

        of = self.settings, self.controls
        frame = pd.DataFrame([row for key, curve in self.curves.items() for row in score_rows(*of, key, curve)])
        exceeds = [name for name in map(str, frame) if name.startswith("exceeds_")]
        return frame.astype({"iteration": "Int64", **dict.fromkeys(exceeds, "boolean")})

    def direction(self, category: str, view: str, site: Site) -> Direction:
        """Return the probes' weights at a site, in raw features.

        Raises:
            UnknownSiteError: If there are none, as for a target other than a side.
        """
        try:
            return self.directions[category, view, site]
        except KeyError:
            settings = self.settings
            hint = (
                ""
                if settings.balanced
                else f"; probes of {settings.target!r} store no directions, those of a side do"
            )
            raise UnknownSiteError(
                f"there is no direction of {site}, category {category!r}, view {view!r}; probed were the sites of "
                f"categories {', '.join(settings.categories)} in views {', '.join(settings.views)}{hint}"
            ) from None


def episodes_sha256(run: RunReader) -> str:
    """Return a hash that identifies the episodes that a run holds now."""
    return sha256_json(sorted(run.episodes["episode_id"].astype(str)))


# -- the table of best sites -------------------------------------------------------------------------------------

_TIES = {"+": "as many other sites tie with it"}
_LEGEND = "the score of a chosen site is too high"
_OF_SIDE = "; `retention` corrects it"
_OF_LABEL = ". Chance: mean score of this site with exchanged labels"


def best_sites_table(fitted: Sequence[ProbeResults], splits: bool = True) -> Table:
    """Return a table with a row per category, stream, view and captured inference, and per control.

    Args:
        fitted: Probes of one target in a run, one per inference.
        splits: Whether to split a table that is too wide, instead of leaving columns out. Controls of a side are
            listed only then.
    """
    first, several_calls = fitted[0].settings, len(fitted) > 1
    several_views, metric = len(first.views) > 1, "accuracy %" if first.balanced else METRICS[first.task]
    rows: list[tuple[Cell | str, ...]] = []
    for results in fitted:
        call = f"call {results.settings.call}" if several_calls else ""
        for row in best_sites(results.scores):
            view = str(row["view"]) if several_views else ""
            name = " · ".join(filter(None, (_name(results, row["category"], row["stream"]), view, call)))
            met, missed = exceeded_controls(results, row)
            not_shown = f"not shown: {', '.join(missed)}" if missed else ""
            begin = Cell(row["first"], first.write_score)
            exceeds = Cell("; ".join(filter(None, (", ".join(met), not_shown))) or None)
            rows.append((name, *site_cells(row, first.write_score), exceeds, Cell(int(row["n"])), begin))
        for control in results.controls.scores if splits or not first.balanced else ():
            view = control.view if several_views else ""
            where = _name(results, control.category, control.stream)
            name = " · ".join(filter(None, [f"control {control.name}", where, view, call]))
            score = Cell(control.score, first.write_score, control.ci)
            chance = Cell(control.chance, first.write_score)
            p = Cell(control.p, p_text, after="" if control.p is None else " (this control alone)")
            rows.append((name, "", score, chance, p, "", Cell(control.n), ""))
    headings = (
        "category" if first.balanced else "stream",
        "best site",
        f"{metric} [95 %]",
        "chance",
        "family-wise p",
        "exceeds",
        "n",
        "first iteration",
    )
    notes = [_LEGEND + (_OF_SIDE if first.balanced else _OF_LABEL)]
    overflow = "split" if splits else "leave out"
    return Table.of(
        ", ".join(_title(fitted, several_views)),
        headings,
        rows,
        legend=Legend(marks=_TIES),
        notes=notes,
        overflow=overflow,
    )


def _title(fitted: Sequence[ProbeResults], several_views: bool) -> Iterator[str]:
    settings = fitted[0].settings
    yield f"{settings.target}: best site per stream" if not settings.balanced else "Best site per stream"
    if not settings.balanced:
        yield settings.task
    if not several_views:
        yield f"view {settings.views[0]}"
    if len(fitted) == 1 and settings.window == 1:
        yield f"call {settings.call}"
    if settings.align_to:
        yield f"from {settings.align_to.partition('#')[0]} on"
    if settings.random_weights:
        yield "RANDOM WEIGHTS"


def _name(results: ProbeResults, category: str, stream: str) -> str:
    """Return the category, and for a target other than a side the stream."""
    if results.settings.balanced:
        return str(category)  # as --categories takes it
    pooled = results.settings.categories == (EVERYWHERE,)
    return " · ".join(filter(None, ["" if pooled else str(category), label_of(stream) if stream else ""]))


def exceeded_controls(results: ProbeResults, row: "pd.Series") -> tuple[list[str], list[str]]:
    """Return the controls that a site is shown to exceed, and those that it is not shown to exceed.

    Chance is among them.
    """
    exceeds = results.controls.exceeds(row["category"], row["view"], row["site"], row["p_fwe"])
    return [name for name in exceeds if exceeds[name]], [name for name in exceeds if exceeds[name] is False]
