"""Nested logistic probes of one site, for the labels and all their permutations at once.

The inner folds choose C by log-loss. The problems are solved in one of three ways, all with the same optimum.
Every fold is solved by itself. Or small problems of all folds are stacked. Or, with many samples, training sets,
permutations and values of C share the large products. To choose C only the losses of its optima are needed. Rough
optima do for that, as long as the bounds of their errors leave no doubt about the choice.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import batched, chain
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit.errors import TooFewGroupsError
from probe_kit.statistics.folds import INNER_FOLDS, OUTER_FOLDS, Fold
from probe_kit.train.crossval.distinct_labels import DistinctProblems
from probe_kit.train.crossval.joint_objective import JointProblems, JointSite, solve
from probe_kit.train.crossval.nested_folds import (
    STRENGTHS,
    FittedFold,
    InnerQuality,
    NestedFold,
    can_be_least,
    select_c,
)
from probe_kit.train.crossval.task_scores import log_loss, log_losses
from probe_kit.train.samples import Samples
from probe_kit.train.solver.arrays import Array, array_namespace, to_device_of, to_numpy
from probe_kit.train.solver.design_matrix import (
    IN_MEMORY,
    DenseDesign,
    Projection,
    StackedDesign,
    StreamedDesign,
    fold_samples,
    stack_samples,
)
from probe_kit.train.solver.logistic import LogisticSolver
from probe_kit.train.solver.rough_path import RoughOptima, decision_bounds

# -- the probes of a site -----------------------------------------------------------------------------------------

Choice = tuple[Matrix, InnerQuality]
"""The strengths (K,) of an outer fold's label columns, and the inner quality at them."""


def cross_validate(
    samples: Samples, labels: NDArray[np.bool_], folds: list[NestedFold], *, all_qualities: bool = True
) -> list[FittedFold]:
    """Return the probes of every outer fold, each column of (E, K) labels on its own.

    Problems that `can_be_joint` names, such as wide tokens with few columns, are solved for all training sets
    together where these have the same features. Small problems are also solved together.

    Args:
        samples: Samples of E episodes.
        labels: (E, K) labels.
        folds: Outer folds, each with inner folds.
        all_qualities: Whether the inner quality is needed of all columns, and not of the first one alone. Without,
            C may be chosen by rough optima where these settle the choice.

    Raises:
        ProbeNotConvergedError: If a probe stops before its optimum.
        TooFewGroupsError: For a training set with a single class.
    """
    if can_be_joint(samples, labels.shape[1]) and (site := JointSite.of(samples, folds)).alike:
        return cross_validate_jointly(site, samples, labels, folds)
    if not all_qualities and can_be_rough(samples, labels):
        choices = choose_roughly(samples, labels, folds)
    elif is_small(samples, labels):
        choices = choose_together(samples, labels, folds)
    else:
        choices = [choose_strengths(samples, labels, fold.inner) for fold in folds]
    if is_small(samples, labels):
        return _fit_together(samples, labels, folds, choices)
    return [_fit_fold(samples, labels, fold.outer, *choice) for fold, choice in zip(folds, choices, strict=True)]


class _Training(NamedTuple):
    """The samples of one fold.

    Attributes:
        fold: Its training and test episodes.
        design: Its n training samples in R coordinates.
        held_out: (m, R) coordinates of the test episodes.
    """

    fold: Fold
    design: DenseDesign | StreamedDesign
    held_out: Array

    @classmethod
    def of(cls, samples: Samples, fold: Fold) -> "_Training":
        return cls(fold, *fold_samples(samples.of(fold.train).features, samples.of(fold.test).means))

    @classmethod
    def projected(cls, samples: Samples, fold: Fold) -> "tuple[_Training, Projection]":
        """Return the samples, and the way from their weights to those of raw features."""
        coordinates = Projection.fit(samples.of(fold.train).features)
        return cls(fold, coordinates.train, coordinates(samples.of(fold.test).means)), coordinates


# -- every fold by itself -----------------------------------------------------------------------------------------


def choose_strengths(samples: Samples, labels: NDArray[np.bool_], folds: list[Fold]) -> Choice:
    """Return for each label column the C with the lowest held-out log-loss, and the quality there.

    On ties it is the smaller C.
    """
    return _choose_alone(samples, labels, (_Training.of(samples, fold) for fold in folds))


def _choose_alone(
    samples: Samples, labels: NDArray[np.bool_], inner: Iterable[_Training], strengths: Matrix = STRENGTHS
) -> Choice:
    loss = np.zeros((strengths.size, labels.shape[1]))
    by_episode = np.zeros((strengths.size, len(labels)))
    for training in inner:
        test, truth = training.fold.test, labels[training.fold.test]
        for step, weights in enumerate(_path(samples, labels, training, strengths)):
            decisions = to_numpy(training.held_out @ weights)
            loss[step] += log_loss(decisions, truth) * test.size
            by_episode[step, test] = log_losses(decisions[:, 0], truth[:, 0])
    best = select_c(loss)
    return strengths[best], InnerQuality.of(-loss, -by_episode, best)


def _path(samples: Samples, labels: NDArray[np.bool_], training: _Training, strengths: Matrix) -> Iterator[Array]:
    """Yield the optimal weights (R, K) of a fold's training samples, for each of ascending `strengths`."""
    problems = DistinctProblems.of(labels[training.fold.train])
    by_sample = samples.of(training.fold.train).repeat(problems.labels)
    return map(problems.by_column, LogisticSolver(training.design).path(by_sample, strengths))


def _fit_fold(
    samples: Samples, labels: NDArray[np.bool_], fold: Fold, strengths: Matrix, inner: InnerQuality
) -> FittedFold:
    training, coordinates = _Training.projected(samples, fold)
    decisions = np.empty((fold.test.size, labels.shape[1]))
    for strength in np.unique(strengths):
        columns = np.flatnonzero(strengths == strength)
        (weights,) = _path(samples, labels[:, columns], training, np.array([strength]))
        decisions[:, columns] = to_numpy(training.held_out @ weights)
        if columns[0] == 0:
            first = weights
    return FittedFold.of(coordinates, first, decisions, strengths, inner)


# -- small problems, stacked --------------------------------------------------------------------------------------

STACKED_COLUMNS, SMALL_HESSIAN = 32, 2**20
"""Label columns, and multiplications of each (N · R²), up to which whole Hessians cost less than the many small
products of conjugate gradients."""

COLUMNS_AT_ONCE = 128
"""Label columns of all folds together: more of them do not fit into a processor's cache."""


def is_small(samples: Samples, labels: NDArray[np.bool_]) -> bool:
    """Whether the problems of (E, K) labels are few and small enough to be solved together."""
    count, width = samples.features.shape
    return samples.pools and labels.shape[1] <= STACKED_COLUMNS and count * min(count, width) ** 2 <= SMALL_HESSIAN


def choose_together(samples: Samples, labels: NDArray[np.bool_], folds: Sequence[NestedFold]) -> list[Choice]:
    """Return the choice of every outer fold, of whose inner folds many are solved at once.

    Raises:
        ProbeNotConvergedError: If a probe stops before its optimum.
        TooFewGroupsError: For a training set with a single class.
    """
    return _choose_stacked(labels, [[_Training.of(samples, inner) for inner in fold.inner] for fold in folds])


def _choose_stacked(
    labels: NDArray[np.bool_], inner: Sequence[Sequence[_Training]], strengths: Matrix = STRENGTHS
) -> list[Choice]:
    trainings = [training for of_fold in inner for training in of_fold]
    problems = [DistinctProblems.of(labels[training.fold.train]) for training in trainings]
    parts = [together.losses(strengths) for together in _Together.parts(trainings, labels, problems)]
    loss, by_episode = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    begins = _first_inner(inner)
    loss, by_episode = _sum_inner(loss, begins), _sum_inner(by_episode, begins)
    best = select_c(loss)
    return [
        (strengths[best[number]], InnerQuality.of(-loss[:, number], -by_episode[:, number], best[number]))
        for number in range(len(inner))
    ]


def _first_inner(inner: Sequence[Sequence[_Training]]) -> NDArray[np.intp]:
    """Return the number of the first inner fold of every outer fold, where all are counted together."""
    return np.cumsum([0, *(len(trainings) for trainings in inner[:-1])])


def _sum_inner(losses: Matrix, begins: NDArray[np.intp]) -> Matrix:
    """Return losses (C, inner folds, …) summed by outer fold, which begin where `_first_inner` says."""
    return np.add.reduceat(losses, begins, axis=1)


def _fit_together(
    samples: Samples, labels: NDArray[np.bool_], folds: Sequence[NestedFold], choices: Sequence[Choice]
) -> list[FittedFold]:
    """Return the probes of every outer fold, each column of (E, K) labels on its own."""
    trainings, coordinates = zip(*(_Training.projected(samples, fold.outer) for fold in folds), strict=True)
    problems = [
        DistinctProblems.of(labels[fold.outer.train], strengths)
        for fold, (strengths, _) in zip(folds, choices, strict=True)
    ]
    decided = (together.decide() for together in _Together.parts(trainings, labels, problems))
    of_folds = zip(coordinates, chain.from_iterable(decided), choices, strict=True)
    return [
        FittedFold.of(projection, weights, decisions, *choice)
        for projection, (weights, decisions), choice in of_folds
    ]


@dataclass(frozen=True)
class _Together:
    """The problems of F folds, solved together.

    The solver's columns are the problems of the first fold, then those of the second one, and so on.

    Attributes:
        labels: (E, K) labels of all episodes.
        trainings: Training and test samples of every fold.
        problems: The problems of every fold.
        signs: (N, P) labels −1/+1 of all problems, 0 where a fold has fewer than N samples.
    """

    labels: NDArray[np.bool_]
    trainings: Sequence[_Training]
    problems: Sequence[DistinctProblems]
    solver: LogisticSolver
    signs: Array

    @classmethod
    def parts(
        cls, trainings: Sequence[_Training], labels: NDArray[np.bool_], problems: Sequence[DistinctProblems]
    ) -> Iterator[Self]:
        """Yield the folds in parts whose problems fit into a processor's cache."""
        at_once = max(1, COLUMNS_AT_ONCE // max(map(len, problems)))
        for some, their_problems in zip(batched(trainings, at_once), batched(problems, at_once), strict=True):
            design = StackedDesign.of_folds([part.design for part in some], [len(part) for part in their_problems])
            signs = np.hstack([_fill_up(part.signs, design.shape[0]) for part in their_problems])
            yield cls(labels, some, their_problems, LogisticSolver(design), to_device_of(design.samples, signs))

    def losses(self, strengths: Matrix) -> tuple[Matrix, Matrix]:
        """Return the log-losses along ascending C: of all label columns, and of the first one by episode.

        Returns:
            (C, F, K) log-losses of the test episodes, summed; (C, F, E) log-losses of the first column, which are
            0 outside of a fold's test episodes.
        """
        loss = np.empty((strengths.size, len(self.trainings), self.labels.shape[1]))
        by_episode = np.zeros((strengths.size, len(self.trainings), len(self.labels)))
        for step, weights in enumerate(self.solver.path_of_signs(self.signs, strengths)):
            for number, (training, of_fold) in enumerate(
                zip(self.trainings, self._of_folds(weights), strict=True)
            ):
                test = training.fold.test
                decisions, truth = to_numpy(training.held_out @ of_fold), self.labels[test]
                loss[step, number] = log_loss(decisions, truth) * test.size
                by_episode[step, number, test] = log_losses(decisions[:, 0], truth[:, 0])
        return loss, by_episode

    def decide(self) -> Iterator[tuple[Array, Matrix]]:
        """Yield the weights (R, K) of every fold at the C of its problems, and the decisions (m, K)."""
        strengths = np.concatenate([of_fold.strengths for of_fold in self.problems])
        (weights,) = self.solver.path_of_signs(self.signs, [to_device_of(self.signs, strengths)])
        for training, of_fold in zip(self.trainings, self._of_folds(weights), strict=True):
            yield of_fold, to_numpy(training.held_out @ of_fold)

    def _of_folds(self, weights: Array) -> Iterator[Array]:
        """Yield the weights (R, K) of every fold, without the padding."""
        first = 0
        for training, problems in zip(self.trainings, self.problems, strict=True):
            of_fold, rank = weights[:, first : first + len(problems)], training.design.shape[1]
            first += len(problems)
            yield problems.by_column(array_namespace(of_fold).concatenate([of_fold[: rank - 1], of_fold[-1:]]))


def _fill_up(signs: Matrix, count: int) -> Matrix:
    """Return signs (n, U) with so many rows, the further ones 0."""
    return np.pad(signs, ((0, count - len(signs)), (0, 0)))


# -- rough optima, where they settle the choice of C --------------------------------------------------------------

ROUGH_FROM, ROUGH_AT_ONCE = 8, 800
"""Label columns from which on rough optima save more than they cost, and columns of all folds together, beyond
which float32 arrays of some dozen samples leave a processor's cache."""


def can_be_rough(samples: Samples, labels: NDArray[np.bool_]) -> bool:
    """Whether rough optima can choose C for most columns of (E, K) labels: of pooled samples, outside a device."""
    count, width = samples.features.shape
    in_memory = 8 * OUTER_FOLDS * INNER_FOLDS * count * min(count, width) <= IN_MEMORY
    return samples.pools and isinstance(samples.means, np.ndarray) and labels.shape[1] >= ROUGH_FROM and in_memory


def choose_roughly(samples: Samples, labels: NDArray[np.bool_], folds: Sequence[NestedFold]) -> list[Choice]:
    """Return the choices that exact optima make, from rough ones in float32 as far as these settle them.

    A choice is settled if no other C can have the lowest log-loss, by the bounds of the rough decisions. The first
    column, whose inner quality is needed, and those that are not settled are solved exactly. The total quality of
    a settled column is rough.

    Raises:
        ProbeNotConvergedError: If an exact probe stops before its optimum.
        TooFewGroupsError: For a training set with a single class.
    """
    inner = [[_Training.of(samples, fold) for fold in nested.inner] for nested in folds]
    problems = [[DistinctProblems.of(labels[fold.train]) for fold in nested.inner] for nested in folds]
    at_once = max(1, ROUGH_AT_ONCE // max(sum(map(len, of_fold)) for of_fold in problems))
    some_at_once = zip(batched(inner, at_once), batched(problems, at_once), strict=True)
    parts = [_rough_losses(labels, *some) for some in some_at_once]
    loss, bound = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    best, can_be_best = select_c(loss), can_be_least(loss - bound, loss + bound)
    # What one outer fold leaves open is solved for all: few columns more, in the same calls.
    open_ = (can_be_best.sum(axis=0) > 1).any(axis=0)
    open_[0] = True
    few = labels[:, open_]
    # Every optimum starts from the one before: those of larger C than any that can be best are not needed.
    grid = STRENGTHS[: 1 + np.flatnonzero(can_be_best[..., open_].any(axis=(1, 2))).max()]
    if is_small(samples, few):
        exact = _choose_stacked(few, inner, grid)
    else:
        exact = [_choose_alone(samples, few, trainings, grid) for trainings in inner]
    choices: list[Choice] = []
    for number, (exact_strengths, quality) in enumerate(exact):
        strengths = STRENGTHS[best[number]]
        total = -np.take_along_axis(loss[:, number], best[None, number], 0)[0]
        strengths[open_], total[open_] = exact_strengths, quality.total
        choices.append((strengths, InnerQuality(total, quality.first)))
    return choices


@dataclass(frozen=True)
class _InnerFolds:
    """Inner folds of several outer folds, F together, with K label columns that pose up to U problems in each.

    Attributes:
        samples: (F, N, R) training samples, filled up with zeros.
        signs: (F, U, N) their labels −1/+1 in every problem, filled up with zeros; a fold of fewer problems
            repeats its last one.
        held_out: (F, T, R) test samples, filled up with zeros.
        truth: (F, K, T) their labels −1/+1, filled up with zeros, and with exchanged classes where the column's
            problem has them so.
        problem_of: (F, K) problem of every label column.
        outer: (F,) number of the outer fold of each.
        turn: (F,) number of each among those of its outer fold.
    """

    samples: Matrix
    signs: Matrix
    held_out: Matrix
    truth: Matrix
    problem_of: NDArray[np.intp]
    outer: NDArray[np.intp]
    turn: NDArray[np.intp]

    @classmethod
    def of(
        cls,
        inner: Sequence[Sequence[_Training]],
        problems: Sequence[Sequence[DistinctProblems]],
        labels: NDArray[np.bool_],
    ) -> Self:
        """Return the folds of (E, K) labels with their problems."""
        trainings = [training for of_fold in inner for training in of_fold]
        of_folds = [of_fold for of_outer in problems for of_fold in of_outer]
        counts = [len(part) for part in of_folds]
        samples = StackedDesign.of_folds([part.design for part in trainings], counts).samples
        repeated = np.arange(max(counts))
        signs = np.stack(
            [_fill_up(part.signs, samples.shape[1]).T[repeated.clip(max=len(part) - 1)] for part in of_folds]
        )
        held_out = stack_samples([part.held_out for part in trainings])
        truth = np.zeros((len(trainings), labels.shape[1], held_out.shape[1]))
        for of_fold, training, part in zip(truth, trainings, of_folds, strict=True):
            of_fold[:, : training.fold.test.size] = part.sign[:, None] * (2.0 * labels[training.fold.test].T - 1.0)
        numbers = [(outer, turn) for outer, of_fold in enumerate(inner) for turn in range(len(of_fold))]
        problem_of = np.stack([part.problem_of for part in of_folds])
        return cls(samples, signs, held_out, truth, problem_of, *np.array(numbers).T)

    def are_needed(self, folds: NDArray[np.intp], columns: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which problems (G, U) of `folds` (G,) are those of a mask of label columns (G, K)."""
        needed = np.zeros((folds.size, self.signs.shape[1]), bool)
        fold, column = np.nonzero(columns)
        needed[fold, self.problem_of[folds[fold], column]] = True
        return needed

    def losses(
        self, optima: RoughOptima, strength: float, folds: NDArray[np.intp], problems: NDArray[np.intp]
    ) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], Matrix, Matrix]:
        """Return log-losses of label columns, summed over the test samples.

        Args:
            optima: Of `folds` (G,) and, of each, `problems` (G, L).
            strength: Their C.
            folds: Numbers of the folds.
            problems: Numbers of the problems.

        Returns:
            Folds and columns of the losses, (M,) each: all columns whose problem is among `problems`. Their losses
            (M,), and by how much these can differ.
        """
        held_out = self.held_out[folds]
        decisions = optima.weights @ held_out.swapaxes(1, 2)
        signs = self.signs[folds[:, None], problems]
        bounds = decision_bounds(self.samples[folds], signs, optima.weights, strength, held_out)
        # Not by a product, in which an infinite bound of what fills up would be no number.
        bounds[np.broadcast_to(self.truth[folds, :1] == 0, bounds.shape)] = 0.0
        place_of = np.full((folds.size, self.signs.shape[1]), -1)
        np.put_along_axis(place_of, problems, np.arange(problems.shape[1])[None], axis=1)
        places = np.take_along_axis(place_of, self.problem_of[folds], axis=1)
        fold, column = np.nonzero(places >= 0)
        truth, solved = self.truth[folds[fold], column], (fold, places[fold, column])
        losses = np.logaddexp(0.0, -truth * decisions[solved]) * abs(truth)
        return (folds[fold], column), losses.sum(axis=1), bounds.sum(axis=2)[solved]


@dataclass(frozen=True)
class _RoughLosses:
    """Losses of rough optima, as far as they were computed; all (C, F, K).

    Attributes:
        begins: Numbers of the first inner folds, see `_first_inner`.
        loss: Log-losses of the test episodes of every inner fold, summed.
        bound: By how much these can differ from those of exact optima.
        is_done: Whether the loss was computed.
    """

    begins: NDArray[np.intp]
    loss: Matrix
    bound: Matrix
    is_done: NDArray[np.bool_]

    @classmethod
    def none(cls, begins: NDArray[np.intp], folds: int, columns: int) -> Self:
        """Return losses of so many inner folds and label columns, of which none was computed."""
        shape = STRENGTHS.size, folds, columns
        return cls(begins, np.zeros(shape), np.zeros(shape), np.zeros(shape, bool))

    def add(self, where: tuple[Any, ...], loss: Matrix, bound: Matrix) -> None:
        """Add losses that were computed."""
        self.loss[where], self.bound[where], self.is_done[where] = loss, bound, True

    def can_win(self) -> NDArray[np.bool_]:
        """Return whether a C can have the least loss of an outer fold, (C, outer folds, K)."""
        loss, bound = self.totals()
        # A loss is not negative, so that the sum of some inner folds is at most that of all.
        return can_be_least(_sum_inner(self.loss - self.bound, self.begins), loss + bound)

    def totals(self) -> tuple[Matrix, Matrix]:
        """Return losses and bounds summed by outer fold; a loss is infinite where an inner fold is not done."""
        is_whole = np.logical_and.reduceat(self.is_done, self.begins, axis=1)
        loss, bound = (_sum_inner(part, self.begins) for part in (self.loss, self.bound))
        return np.where(is_whole, loss, np.inf), np.where(is_whole, bound, 0.0)


CHEAP = 5
"""Values of C, from the smallest on, that are tried in all inner folds at once. Larger ones take most of the time:
they are tried in one inner fold after another, since few label columns can still prefer them after the first."""


def _rough_losses(
    labels: NDArray[np.bool_],
    inner: Sequence[Sequence[_Training]],
    problems: Sequence[Sequence[DistinctProblems]],
) -> tuple[Matrix, Matrix]:
    """Return log-losses (C, F, K) of the inner test episodes, summed, of rough optima, and bounds of their errors.

    The loss is infinite where it cannot be the least: losses are not negative, so that those of some inner folds
    can show it. The others were not computed then.

    Args:
        labels: (E, K) labels.
        inner: Inner folds of F outer folds.
        problems: The problems of every inner fold.
    """
    folds = _InnerFolds.of(inner, problems, labels)
    sums = _RoughLosses.none(_first_inner(inner), folds.turn.size, labels.shape[1])
    start = RoughOptima.start(folds.samples, folds.signs)
    cheap, dear = np.split(np.arange(STRENGTHS.size), [CHEAP])
    by_turn = [np.flatnonzero(folds.turn == turn) for turn in range(folds.turn.max() + 1)]
    for some, steps in ((np.arange(folds.turn.size), cheap), *((turn, dear) for turn in by_turn)):
        numbers = np.tile(np.arange(folds.signs.shape[1]), (some.size, 1))
        optima = start if steps is cheap else start.select(some, numbers)
        for step in steps:
            can_win: NDArray[np.bool_] = np.any(sums.can_win()[step:], axis=0)
            is_needed = np.take_along_axis(folds.are_needed(some, can_win[folds.outer[some]]), numbers, 1)
            most = is_needed.sum(axis=1).max()
            if most == 0:
                break
            if most < numbers.shape[1]:  # as many of every fold, first those that are needed
                order = np.argsort(~is_needed, axis=1, kind="stable")[:, :most]
                numbers = np.take_along_axis(numbers, order, 1)
                optima = optima.select(np.arange(some.size), order)
            optima.advance(STRENGTHS[step])
            where, loss, bound = folds.losses(optima, STRENGTHS[step], some, numbers)
            sums.add((step, *where), loss, bound)
    return sums.totals()


# -- many samples, whose products are shared ----------------------------------------------------------------------

COLUMN_MEMORY = 2**29
"""Bytes that problems solved at once may take, beyond the samples and the arrays made of them once."""

SHARED_COLUMNS, FEATURES_PER_COLUMN = 10, 50
"""Label columns up to which sharing pays, and features for one more. Axes of a training set's own cost as much as
many columns; each column then costs half, as products pass over its own samples only, and never over axes."""

LEAST_WIDTH = 96
"""Features below which the training sets' own axes cost next to nothing, and sharing products saves nothing."""


def can_be_joint(samples: Samples, columns: int) -> bool:
    """Whether a site's tokens are so many, and so wide, that its training sets should be solved together.

    They always are where inner training sets, three fifths of the tokens, are too large to be turned to axes of
    their own once. They never are on a device, where it was not tried.
    """
    count, width = samples.features.shape
    if samples.pools or not isinstance(samples.means, np.ndarray) or width < LEAST_WIDTH or count < width:
        return False
    few = columns <= SHARED_COLUMNS + width // FEATURES_PER_COLUMN
    return few or 3 * count // 5 * width * 8 > IN_MEMORY


def cross_validate_jointly(
    site: JointSite, samples: Samples, labels: NDArray[np.bool_], folds: Sequence[NestedFold]
) -> list[FittedFold]:
    """Return the probes of every outer fold, each column of (E, P) labels on its own.

    As many columns are solved at once as memory allows. Every C starts from zero. With the solution of the
    previous C as a start, problems took nearly as many products, which were a seventh as wide and so half as fast.

    Raises:
        ProbeNotConvergedError: If a probe stops before its optimum.
        TooFewGroupsError: For a training set with a single class.
    """
    share = site.sets.member @ labels / site.sets.member.sum(axis=1)[:, None]
    if ((share == 0) | (share == 1)).any():
        raise TooFewGroupsError("all training samples have the same label; a probe needs both classes")
    step = labels_at_once(site, folds)
    parts = [
        _SharedColumns(site, samples, labels[:, first : first + step], folds).fitted()
        for first in range(0, labels.shape[1], step)
    ]
    return [_join_parts(fold) for fold in zip(*parts, strict=True)]


def labels_at_once(site: JointSite, folds: Sequence[NestedFold]) -> int:
    """Return the number of label columns whose problems, with all C, fit into COLUMN_MEMORY; at least one."""
    return max(1, _times_at_once(site, folds) // STRENGTHS.size)


def _times_at_once(site: JointSite, folds: Sequence[NestedFold]) -> int:
    """Return how often the problems of all inner folds fit into COLUMN_MEMORY; at least once.

    A problem takes 12 bytes per sample: three float32 vectors of its curvatures while a step is found. It takes
    128 bytes per weight: the solver's rows of weights, directions and products, counted generously as 16 float64.
    """
    count, width = site.features.shape
    problems = sum(len(fold.inner) for fold in folds)
    return max(1, COLUMN_MEMORY // (problems * (12 * count + 128 * (width + 1))))


@dataclass(frozen=True)
class _SharedColumns:
    """The label columns (E, L), on all training sets of a site."""

    site: JointSite
    samples: Samples
    labels: NDArray[np.bool_]
    folds: Sequence[NestedFold]

    def fitted(self) -> list[FittedFold]:
        best, starts, quality = self._select_strengths()
        inner = len(self.site.sets.outer) - len(best)
        fold, column = (part.ravel() for part in np.indices(best.shape))
        problems = self._problems(inner + fold, column, STRENGTHS[best].ravel())
        weights = solve(problems, starts[best.ravel(), fold, column])
        decisions = to_numpy(problems.decisions(weights, self.samples.means)).reshape(*best.shape, -1)
        first = _raw_probes(problems, weights, fold, np.flatnonzero(column == 0))
        return [
            FittedFold(
                decisions[number][:, nested.outer.test].T,
                STRENGTHS[best[number]],
                *first[number],
                quality[number],
            )
            for number, nested in enumerate(self.folds)
        ]

    def _select_strengths(self) -> tuple[NDArray[np.intp], Array, list[InnerQuality]]:
        """Return the chosen C, weights to start from, and the inner quality of every outer fold.

        The weights are the mean of the inner folds' weights.

        Returns:
            Position (F, L) of the chosen C by outer fold and column; weights (C, F, L, D + 1) to start from; and
            the quality of every outer fold.
        """
        sets = [(number, inner) for number, nested in enumerate(self.folds) for inner in nested.inner]
        of_fold = np.array([number for number, _ in sets])
        loss = np.zeros((STRENGTHS.size, len(self.folds), self.labels.shape[1]))
        by_episode = np.zeros((STRENGTHS.size, len(self.folds), len(self.labels)))
        starts = []
        for step, (weights, of_sets) in enumerate(self._along_grid(len(sets))):
            for (number, inner), decisions in zip(sets, of_sets, strict=True):
                decided, truth = decisions[:, inner.test].T, self.labels[inner.test]
                loss[step, number] += log_loss(decided, truth) * inner.test.size
                by_episode[step, number, inner.test] = log_losses(decided[:, 0], truth[:, 0])
            starts.append([weights[of_fold == number].mean(axis=0) for number in range(len(self.folds))])
        xp = array_namespace(self.site.mean)
        best = select_c(loss)
        quality = [
            InnerQuality.of(-loss[:, number], -by_episode[:, number], best[number])
            for number in range(len(self.folds))
        ]
        return best, xp.stack([xp.stack(by_fold) for by_fold in starts]), quality

    def _along_grid(self, sets: int) -> Iterator[tuple[Array, Matrix]]:
        """Yield for each C weights (S, L, D + 1) and decisions (S, L, E) of all inner folds, many at once."""
        xp, columns = array_namespace(self.site.mean), self.labels.shape[1]
        width = len(self.site.mean) + 1
        for some in batched(STRENGTHS, _times_at_once(self.site, self.folds)):
            grid, set_of, column = (part.ravel() for part in np.indices((len(some), sets, columns)))
            problems = self._problems(set_of, column, np.array(some)[grid])
            start = xp.zeros((len(problems), width), dtype=xp.float64, device=self.site.mean.device)
            weights = solve(problems, start)
            decided = to_numpy(problems.decisions(weights, self.samples.means))
            shape = len(some), sets, columns, -1
            yield from zip(weights.reshape(shape), decided.reshape(shape), strict=True)

    def _problems(
        self, sets: NDArray[np.intp], columns: NDArray[np.intp], strength: NDArray[np.float64]
    ) -> JointProblems:
        signs = np.where(self.labels, 1, -1).astype(np.int8).T
        return JointProblems(self.site, sets, signs[columns], strength)


def _raw_probes(
    problems: JointProblems, weights: Array, fold: NDArray[np.intp], some: NDArray[np.intp]
) -> dict[int, tuple[Matrix, float, float]]:
    """Return raw weights, intercept and spread of `some` problems, by their outer fold."""
    if not some.size:
        return {}
    subset = JointProblems(problems.site, problems.set_of[some], problems.signs[some], problems.strength[some])
    parts = (*subset.raw(weights[some]), subset.deviations(weights[some]))
    raw, intercepts, along = (to_numpy(part) for part in parts)
    length = np.linalg.norm(raw, axis=1)
    spread = np.where(length > 0, along / np.where(length > 0, length, 1.0), 0.0)
    return {
        int(number): (raw[position], float(intercepts[position]), float(spread[position]))
        for position, number in enumerate(fold[some])
    }


def _join_parts(parts: Sequence[FittedFold]) -> FittedFold:
    """Return one outer fold's probes, found in parts of the columns."""
    decisions = np.concatenate([part.decisions for part in parts], axis=1)
    strengths = np.concatenate([part.strengths for part in parts])
    total = np.concatenate([part.inner.total for part in parts])
    first = parts[0]
    inner = InnerQuality(total, first.inner.first)
    return FittedFold(decisions, strengths, first.weights, first.intercept, first.spread, inner)
