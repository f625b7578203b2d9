"""The samples of a run that a label names: pairs of episode and captured inference, with groups and strata."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NonFiniteActivationError, UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.train.data.captured_call import captured_calls, restrict_to_call
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.labels.label_table import EPISODE, INFERENCE
from probe_kit.train.labels.labels import Labels

REACHED = 0.9
"""Share of the episodes that reach the last inference of the default window."""
_TRUE_OR_FALSE = (("False", "True"), ("no", "yes"), ("0", "1"))
EVERYWHERE = "all"
"""The only stratum where groups exchange everywhere."""


@dataclass(frozen=True)
class LabelledSamples:
    """n samples with a label, episode by episode and inference by inference.

    rows: (n,) positions in the run's episodes. inferences: (n,) captured inference. values: (n,) coded labels.
    groups, strata: (n,) names of the group and of where it exchanges. window: inferences per episode. left_out:
    how many of what have no part in the probes, by reason. aligned: (n,) place in a window that begins at an
    event, None where windows begin at the first inference.
    """

    rows: NDArray[np.intp]
    inferences: NDArray[np.intp]
    values: NDArray[np.float64]
    groups: NDArray[np.str_]
    strata: NDArray[np.str_]
    window: int
    left_out: dict[str, int]
    aligned: NDArray[np.intp] | None = None

    @property
    def steps(self) -> NDArray[np.intp]:
        """(n,) what corresponds between episodes: the place in the window, or the inference."""
        return self.inferences if self.aligned is None else self.aligned

    def of(self, kept: NDArray[np.bool_]) -> "LabelledSamples":
        """Those of the samples that (n,) `kept` names."""
        names = ("rows", "inferences", "values", "groups", "strata", *(["aligned"] * (self.aligned is not None)))
        return replace(self, **{name: getattr(self, name)[kept] for name in names})

    def features(self, run: RunReader, view: str, site: Site) -> NDArray[np.float32]:
        """(n, D) pooled features of one site. Raises NonFiniteActivationError naming the first broken episode."""
        found: NDArray[np.float32] | None = None
        for call in np.unique(self.inferences):
            here = self.inferences == call
            column = run.column(site, view) if call == 0 else run.column(site, view, call)  # type: ignore[call-arg]
            if found is None:
                found = np.empty((self.rows.size, column.shape[1]), np.float32)
            found[here] = column[self.rows[here]]
        assert found is not None, "there are samples"
        broken = np.flatnonzero(~np.isfinite(found).all(axis=1))
        if broken.size:
            name = run.episodes[EPISODE].iloc[int(self.rows[broken[0]])]
            raise NonFiniteActivationError(
                f"{site}, view {view!r}, of {run.location} holds NaN or infinity in {broken.size} samples, the "
                f"first inference {self.inferences[broken[0]]} of {name!r}; expected finite features. Extract "
                "these episodes again"
            )
        return found


def labelled_samples(
    run: RunReader,
    labels: Labels,
    categories: Sequence[str] | None,
    call: int,
    window: int | None,
    align_to: Labels | None = None,
) -> LabelledSamples:
    """The samples of `run` that `labels` name.

    categories: only their episodes; None for all. call: the captured inference that a label of whole episodes
    is decoded from. window: for labels of single inferences how many of each episode, from the first on; None for
    the most that 90 % of the episodes reach. Episodes that end before are left out. align_to: true or false by
    inference; windows begin at the first inference where it is true, and episodes without one are left out.
    Raises UsageError for keys that the run does not have, for groups that split an episode or items, and for an
    event that is not true or false by inference.
    """
    labels, unseen = labels.on(run)
    if labels.per_step and call:
        raise UsageError(
            f"call={call} with labels that have an inference each; expected labels of whole episodes. Use "
            f"--window N for the first N inferences, or leave out the column {INFERENCE!r}"
        )
    table, reached, chosen = _label_grid(run, labels), _reached(run), _of_categories(run, categories)
    start: NDArray[np.intp] = np.full(len(reached), call)
    left_out: dict[str, int] = {}
    if align_to is not None:
        start = _events(run, labels, align_to)
        left_out[f"episodes in which {align_to.target} is never true"] = int((chosen & (start < 0)).sum())
        chosen = chosen & (start >= 0)
    counts = reached.sum(axis=1) - start
    if labels.per_step:
        window = _window(counts[chosen], reached.shape[1], window)
    else:
        if window is not None:
            raise UsageError(f"window={window} with labels of whole episodes; leave it out, or use --call N")
        restrict_to_call(run, call)
        window = 1
        table = np.repeat(table[:, :1], reached.shape[1], axis=1)
    whole = chosen & (counts >= window)
    calls = start[:, None] + np.arange(window)
    values = np.take_along_axis(table, calls.clip(0, table.shape[1] - 1), axis=1)
    labelled = whole[:, None] & np.isfinite(values)
    rows, steps = np.nonzero(labelled)
    groups, strata = _groups(run, labels), _column(run, labels, labels.exchange_within, labels.strata, EVERYWHERE)
    _check_groups(run, labels, groups, strata, np.unique(rows))
    short = f"before inference {call + window - 1}" if align_to is None else f"within {window} inferences of it"
    left_out |= {
        f"episodes that end {short}": int((chosen & ~whole).sum()),
        "episodes without a label": int((whole & ~labelled.any(axis=1)).sum()),
        "inferences without a label": int((~labelled)[labelled.any(axis=1)].sum()),
        f"labels outside the window of {window}": _outside(table[whole], labelled[whole])
        if labels.per_step
        else 0,
        "labels of frames or episodes that the run does not show": unseen,
    }
    return LabelledSamples(
        rows,
        calls[rows, steps],
        values[labelled],
        groups[rows],
        strata[rows],
        window,
        {reason: count for reason, count in left_out.items() if count},
        None if align_to is None else steps,
    )


def _outside(table: NDArray[np.float64], labelled: NDArray[np.bool_]) -> int:
    """How many labels (E, C) of episodes with a whole window are outside it. labelled: (E, window) inside it."""
    return int(np.isfinite(table).sum() - labelled.sum())


def _events(run: RunReader, labels: Labels, align_to: Labels) -> NDArray[np.intp]:
    """(E,) the first inference at which `align_to` is true, -1 without one. Raises UsageError."""
    event, _ = align_to.on(run)
    if not (labels.per_step and event.per_step and event.coded.classes in _TRUE_OR_FALSE):
        raise UsageError(
            f"windows of {labels.described} aligned to {event.described}"
            + (f" with the values {', '.join(event.coded.classes[:4])}" if event.coded.classes else "")
            + "; expected labels per inference, and a column of true and false, yes and no, or 1 and 0, per "
            "inference"
        )
    happened = _label_grid(run, event) == 1
    return np.where(happened.any(axis=1), happened.argmax(axis=1), -1)


def _reached(run: RunReader) -> NDArray[np.bool_]:
    """(E, C) whether an episode has a captured inference."""
    calls = captured_calls(run)
    if not hasattr(run, "reached"):
        return np.ones((len(run.episodes), 1), bool)
    return np.stack([run.reached(call) for call in range(calls)], axis=1)


def _of_categories(run: RunReader, categories: Sequence[str] | None) -> NDArray[np.bool_]:
    if categories is None or EVERYWHERE in categories:
        return np.ones(len(run.episodes), bool)
    chosen: NDArray[np.bool_] = run.episodes["category"].isin(list(categories)).to_numpy()
    return chosen


def _window(counts: NDArray[np.intp], most: int, asked: int | None) -> int:
    """Inferences per episode. counts: those of every episode from the start of its window on."""
    if asked is not None:
        if not 1 <= asked <= most:
            raise UsageError(f"window={asked}; expected 1 to {most}, the captured inferences of an episode")
        return asked
    shares = [float((counts >= size).mean()) if counts.size else 0.0 for size in range(1, most + 1)]
    return max(1, sum(share >= REACHED for share in shares))


def _label_grid(run: RunReader, labels: Labels) -> NDArray[np.float64]:
    """(E, C) labels by episode and inference, or (E, 1) by episode; NaN where there are none.

    Raises UsageError for an episode or inference that the run does not have.
    """
    place = {name: row for row, name in enumerate(run.episodes[EPISODE].astype(str))}
    planned = _planned(run)
    reached = _reached(run)
    grid = np.full((len(place), reached.shape[1] if labels.per_step else 1), np.nan)
    for number, name in enumerate(labels.episodes):
        row = place.get(name)
        if row is None:
            if name in planned:
                continue
            raise UsageError(
                f"{labels.table.where(number)}: {run.location} has no episode {name!r}; it has {len(place)}, such "
                f"as {next(iter(place), 'none')!r}. `probe-kit labels RUN` writes the ids"
            )
        inference = 0 if labels.inferences is None else labels.inferences[number]
        if labels.per_step and not (inference < reached.shape[1] and reached[row, inference]):
            raise UsageError(
                f"{labels.table.where(number)}: episode {name!r} has {int(reached[row].sum())} captured "
                f"inferences, counted from 0; there is no {inference}. Leave the line out, or capture "
                "more with --captured-calls"
            )
        grid[row, inference] = labels.coded.values[number]
    return grid


def _planned(run: Any) -> set[str]:
    """Ids of episodes that a run plans, finished or not, shown or not."""
    root = getattr(run, "root", None)
    return {str(planned["episode_id"]) for planned in root.plan} if root is not None else set()


def _groups(run: RunReader, labels: Labels) -> NDArray[np.str_]:
    """(E,) group of every episode: those of the run, unless others are asked for."""
    if labels.group_by is None:
        return run.episodes["group_id"].to_numpy(dtype=str)
    return _column(run, labels, labels.group_by, labels.groups, EVERYWHERE)


def _column(
    run: RunReader, labels: Labels, name: str | None, cells: Sequence[str] | None, default: str
) -> NDArray[np.str_]:
    """(E,) a column of the table, or else of the run's episodes; empty texts where the table has no line."""
    if name is None:
        return np.full(len(run.episodes), default)
    if cells is None:
        if name not in run.episodes:
            raise UsageError(
                f"neither {labels.table.source} nor the episodes of {run.location} have a column {name!r}; the "
                f"episodes have {', '.join(map(str, run.episodes))}"
            )
        return run.episodes[name].to_numpy(dtype=str)
    first: dict[str, int] = {}
    for number, episode in enumerate(labels.episodes):
        before = first.setdefault(episode, number)
        if cells[before] != cells[number]:
            raise UsageError(
                f"{labels.table.where(number, name)}: episode {episode!r} is in {cells[number]!r}, and in "
                f"{cells[before]!r} in {labels.table.unit} {labels.table.lines[before]}; expected one value"
            )
    return np.array([cells[first[one]] if one in first else "" for one in run.episodes[EPISODE].astype(str)], str)


def _check_groups(
    run: RunReader, labels: Labels, groups: NDArray[np.str_], strata: NDArray[np.str_], rows: NDArray[np.intp]
) -> None:
    """Raise UsageError for groups that separate items with a shared picture, and strata that split a group."""
    own = run.episodes["group_id"].to_numpy(dtype=str) if "group_id" in run.episodes else groups
    for inner, outer, problem in (
        (own, groups, f"--group-by {labels.group_by} separates items that share a picture"),
        (groups, strata, f"--exchange-within {labels.exchange_within} splits a group"),
    ):
        for name, first, other in _split(inner[rows], outer[rows]):
            raise UsageError(
                f"{problem}: group {name!r} is in {first!r} and in {other!r}. Its episodes depend on each other, "
                "so no p would be right. Give a column that is the same within a group, or leave the option out"
            )


def _split(inner: NDArray[np.str_], outer: NDArray[np.str_]) -> Iterator[tuple[str, str, str]]:
    """Every name of `inner` that has two of `outer`, with both."""
    first: dict[str, str] = {}
    for name, other in zip(inner.tolist(), outer.tolist(), strict=True):
        if first.setdefault(name, other) != other:
            yield name, first[name], other
