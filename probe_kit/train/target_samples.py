"""The samples of a run that a target names: pairs of episode and captured inference, with groups and strata."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.table_cells import similar_name
from probe_kit.errors import UsageError
from probe_kit.runs.layout import START
from probe_kit.runs.reader import RunReader, check_call, reached_calls
from probe_kit.train.choices import EVERYWHERE, Incomplete
from probe_kit.train.label_columns import EPISODE, INFERENCE
from probe_kit.train.target import Target

GROUP = "group_id"
"""The column of episodes with the groups of their run."""

REACHED = 0.9
"""Share of the episodes that reach the last inference of the default window.

A choice between long windows and few episodes left out: with 1, one short episode would cut all windows.
"""
_TRUE_OR_FALSE = (("False", "True"), ("no", "yes"), ("0", "1"))


@dataclass(frozen=True)
class TargetSamples:
    """The n samples with a label, episode by episode and inference by inference.

    Attributes:
        rows: (n,) positions in the run's episodes.
        inferences: (n,) captured inference.
        values: (n,) coded labels.
        groups: (n,) name of the group, which folds keep together.
        strata: (n,) name of the stratum, within which groups exchange labels.
        window: Inferences per episode.
        left_out: Number of episodes, inferences and labels that have no part in the probes, by reason.
        aligned: (n,) place in a window that begins at an event, None where windows begin at the first inference.
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
        """The place in the window, or the inference, (n,): it corresponds between episodes."""
        return self.inferences if self.aligned is None else self.aligned

    def of(self, selection: NDArray[Any]) -> "TargetSamples":
        """Return some of the samples, by a mask (n,) or by positions."""
        names = ("rows", "inferences", "values", "groups", "strata", *(["aligned"] * (self.aligned is not None)))
        return replace(self, **{name: getattr(self, name)[selection] for name in names})


def target_samples(
    run: RunReader,
    target: Target,
    categories: Sequence[str] | None,
    call: int,
    window: int | None,
    align_to: Target | None = None,
    incomplete: Incomplete = "keep",
) -> TargetSamples:
    """Return the samples of `run` that `target` names.

    Args:
        run: Run with the episodes and captured inferences.
        target: Labels, with keys of the run or of its data set.
        categories: Categories whose episodes are used; None for all.
        call: The captured inference that a label of whole episodes is decoded from, counted from 0.
        window: For labels of single inferences how many of each episode, from the first on; None for the most that
            90 % of the episodes reach. Episodes that end before are left out.
        align_to: True or false by inference; windows begin at the first inference where it is true, and episodes
            without one are left out.
        incomplete: `drop` leaves out items of which a layout is missing.

    Raises:
        UsageError: For keys that the run does not have, for groups that split an episode or items, and for an
            event that is not true or false by inference.
    """
    target = target.on(run)
    if target.per_step and call:
        raise UsageError(
            f"call={call} with {target.described}, which has a label for every inference; expected one per "
            f"episode. Use --window N for the first N inferences, or leave out the column {INFERENCE!r}"
        )
    check_call(run, call)
    grid, reached = _label_grid(run, target), reached_calls(run)
    selected: NDArray[np.bool_] = np.ones(len(run.episodes), bool)
    if categories is not None and EVERYWHERE not in categories:
        selected = run.episodes["category"].isin(list(categories)).to_numpy()
    start: NDArray[np.intp] = np.full(len(reached), call)
    left_out: dict[str, int] = {}
    if align_to is not None:
        start = _events(run, target, align_to)
        left_out[f"episodes in which {align_to.name} is never true"] = int((selected & (start < 0)).sum())
        selected = selected & (start >= 0)
    counts = reached.sum(axis=1) - start
    if target.per_step:
        window = _window(counts[selected], reached.shape[1], window)
    else:
        if window is not None:
            raise UsageError(
                f"window={window} with {target.described}, a label per episode; leave it out, or use --call N"
            )
        window = 1
        grid = np.repeat(grid[:, :1], reached.shape[1], axis=1)
    complete = _complete(run, counts >= window, incomplete)
    reaching = selected & (counts >= window) & complete
    calls = start[:, None] + np.arange(window)
    values = np.take_along_axis(grid, calls.clip(0, grid.shape[1] - 1), axis=1)
    labelled = reaching[:, None] & np.isfinite(values)
    rows, steps = np.nonzero(labelled)
    groups, strata = groups_of(run, target)
    if not target.balanced:
        _check_groups(run, target, groups, strata, np.unique(rows))
    short = f"before inference {call + window - 1}" if align_to is None else f"within {window} inferences of it"
    outside = int(np.isfinite(grid[reaching]).sum() - labelled[reaching].sum()) if target.per_step else 0
    left_out |= {
        f"episodes that end {short}": int((selected & (counts < window)).sum()),
        "episodes of items without their other layout": int((selected & (counts >= window) & ~complete).sum()),
        "episodes without a label": int((reaching & ~labelled.any(axis=1)).sum()),
        "inferences without a label": int((~labelled)[labelled.any(axis=1)].sum()),
        f"labels outside the window of {window}": outside,
        "labels of frames or episodes that the run does not show": target.unseen,
    }
    return TargetSamples(
        rows,
        calls[rows, steps],
        values[labelled],
        groups[rows],
        strata[rows],
        window,
        {reason: count for reason, count in left_out.items() if count},
        None if align_to is None else steps,
    )


def groups_of(run: RunReader, target: Target) -> tuple[NDArray[np.str_], NDArray[np.str_]]:
    """Return group and stratum of every episode, each (E,): those of the run, unless the target names columns."""
    if target.group_by is None:
        groups: NDArray[np.str_] = run.episodes[GROUP].to_numpy(dtype=str)
    else:
        groups = _column(run, target, target.group_by, target.groups)
    return groups, _column(run, target, target.exchange_within, target.strata)


def dependent_episodes(run: RunReader) -> tuple[str, NDArray[np.str_]]:
    """Return the column (E,) whose equal values depend on each other, and its name.

    Of an environment these are episodes that start with the same observation, whatever groups it names: another
    seed is another start. Of scenes and recordings they are the run's groups.
    """
    episodes = run.episodes
    if START in episodes:
        starts = episodes[START].where(episodes[START].notna(), episodes[EPISODE])
        return START, starts.to_numpy(dtype=str)
    column = EPISODE if getattr(run, "in_own_environment", False) or GROUP not in episodes else GROUP
    return column, episodes[column].to_numpy(dtype=str)


def _complete(run: RunReader, reached: NDArray[np.bool_], incomplete: Incomplete) -> NDArray[np.bool_]:
    """Return whether an episode's item has all layouts, (E,), among the `reached` episodes; all with `keep`.

    Raises:
        UsageError: For `drop` with episodes that have no items or layouts.
    """
    complete = np.ones(reached.size, bool)
    if incomplete == "drop":
        if lacking := [name for name in ("item_id", "layout") if name not in run.episodes]:
            raise UsageError(
                f"incomplete='drop' with the episodes of {run.location}, which have no column {lacking[0]!r}; "
                "expected items in two layouts. Leave --incomplete out"
            )
        episodes = run.episodes[reached]
        layouts = episodes.groupby("item_id")["layout"].transform("nunique")
        complete[np.flatnonzero(reached)] = (layouts == episodes["layout"].nunique()).to_numpy()
    return complete


def _events(run: RunReader, target: Target, align_to: Target) -> NDArray[np.intp]:
    """Return the first inference (E,) at which `align_to` is true, -1 without one.

    Raises:
        UsageError: For labels or events that are not of single inferences, and for an event that is not true or
            false.
    """
    event = align_to.on(run)
    if not (target.per_step and event.per_step and event.coded.classes in _TRUE_OR_FALSE):
        raise UsageError(
            f"windows of {target.described} aligned to {event.described}"
            + (f" with the values {', '.join(event.coded.classes[:4])}" if event.coded.classes else "")
            + "; expected labels per inference, and a column of true and false, yes and no, or 1 and 0, per "
            "inference"
        )
    happened = _label_grid(run, event) == 1
    return np.where(happened.any(axis=1), happened.argmax(axis=1), -1)


def _window(counts: NDArray[np.intp], most: int, requested: int | None) -> int:
    """Return the number of inferences per episode.

    Args:
        counts: Number of inferences of every episode from the start of its window on.
        most: Captured inferences of an episode.
        requested: Number that the user asked for; None for the most that 90 % of the episodes reach.
    """
    if requested is not None:
        if not 1 <= requested <= most:
            raise UsageError(f"window={requested}; expected 1 to {most}, the captured inferences of an episode")
        return requested
    shares = [float((counts >= size).mean()) if counts.size else 0.0 for size in range(1, most + 1)]
    return max(1, sum(share >= REACHED for share in shares))


def _label_grid(run: RunReader, target: Target) -> NDArray[np.float64]:
    """Return the labels (E, C) by episode and inference, or (E, 1) by episode; NaN where there are none.

    Raises:
        UsageError: For an episode or inference that the run does not have.
    """
    row_of = {name: row for row, name in enumerate(run.episodes[EPISODE].astype(str))}
    planned = set(run.planned_ids)
    reached = reached_calls(run)
    grid = np.full((len(row_of), reached.shape[1] if target.per_step else 1), np.nan)
    for number, name in enumerate(target.episodes):
        row = row_of.get(name)
        if row is None:
            if name in planned:  # planned and not shown: another wording, category or an unfinished episode
                continue
            raise UsageError(
                f"{target.table.where(number)}: {run.location} has no episode {name!r}; it has {len(row_of)}, "
                f"such as {next(iter(row_of), 'none')!r}. {_reason(name, [*row_of, *planned])}"
            )
        inference = 0 if target.inferences is None else target.inferences[number]
        if target.per_step and not (inference < reached.shape[1] and reached[row, inference]):
            raise UsageError(
                f"{target.table.where(number)}: episode {name!r} has {int(reached[row].sum())} captured "
                f"inferences, counted from 0; there is no {inference}. Leave the line out, or capture "
                "more with --captured-calls"
            )
        grid[row, inference] = target.coded.values[number]
    return grid


def _reason(name: str, ids: Sequence[str]) -> str:
    """Return why an id is perhaps not that of a run, and what to do."""
    if (similar := similar_name(name, ids)) is None:
        return "`probe-kit labels RUN` writes the ids"
    return (
        f"It has {similar!r}, which a program that takes names for numbers writes so. Read the ids as text, "
        f"in pandas with dtype={{{EPISODE!r}: str}}"
    )


def _column(run: RunReader, target: Target, name: str | None, cells: Sequence[str] | None) -> NDArray[np.str_]:
    """Return a column (E,) of the table, or else of the run's episodes; empty texts where the table has no line.

    Without a name all episodes are alike.
    """
    if name is None:
        return np.full(len(run.episodes), EVERYWHERE)
    if cells is None:
        if name not in run.episodes:
            raise UsageError(
                f"neither {target.table.source} nor the episodes of {run.location} have a column {name!r}; the "
                f"episodes have {', '.join(map(str, run.episodes))}"
            )
        return run.episodes[name].to_numpy(dtype=str)
    first: dict[str, int] = {}
    for number, episode in enumerate(target.episodes):
        before = first.setdefault(episode, number)
        if cells[before] != cells[number]:
            raise UsageError(
                f"{target.table.where(number, name)}: episode {episode!r} is in {cells[number]!r}, and in "
                f"{cells[before]!r} in {target.table.unit} {target.table.lines[before]}; expected one value"
            )
    ids = run.episodes[EPISODE].astype(str)
    return np.array([cells[first[episode]] if episode in first else "" for episode in ids], str)


def _check_groups(
    run: RunReader, target: Target, groups: NDArray[np.str_], strata: NDArray[np.str_], rows: NDArray[np.intp]
) -> None:
    """Raise UsageError for groups that separate what depends on each other, and strata that split a group."""
    column, dependent = dependent_episodes(run)
    same, remedy = (
        "items that share a picture",
        "Give a column that is the same within a group, or leave the option out",
    )
    if column == START:
        same, remedy = "episodes that start with the same observation", f"Give --group-by {START}"
        if target.group_by is None:
            dependent = groups  # the environment's own groups stay; a sweep warns of equal starts
    for inner, outer, problem, advice in (
        (dependent, groups, f"--group-by {target.group_by} separates {same}", remedy),
        (
            groups, strata, f"--exchange-within {target.exchange_within} splits a group",
            "Give a column that is the same within a group, or leave the option out",
        ),
    ):  # fmt: skip
        first: dict[str, str] = {}
        for name, other in zip(inner[rows].tolist(), outer[rows].tolist(), strict=True):
            if first.setdefault(name, other) != other:
                raise UsageError(
                    f"{problem}: group {name!r} is in {first[name]!r} and in {other!r}. Its episodes depend on "
                    f"each other, so no p would be right. {advice}"
                )
