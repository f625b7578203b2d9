"""Concept erasure: the linearly decodable answer is removed from each token, with random controls.

This file has the intervention, its effects and their table. The fits are in `erasers`; interchange and steer use
them too (`--direction mean-difference:K`). Erasure gives the weakest evidence of all kinds. A policy may read what
is not linear. An answer that is erased at one place may pass at another. Other information that is removed with it
may disrupt the task. Erasers are fitted at every token position: one of the mean over tokens would hide the answer
from a probe of that mean, and leave the action as it is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np

from probe_kit._tables.content import Cell as TableCell
from probe_kit._tables.content import absent
from probe_kit._tables.numbers import number, percent, with_sign
from probe_kit.errors import UsageError
from probe_kit.hooks.capturing.edits import Identity, TokenIndex, apply_patch
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.edited_cells import EditedCell
from probe_kit.intervene.erasers import Eraser, Method
from probe_kit.intervene.kinds.base import (
    EffectColumn,
    EffectRow,
    Intervention,
    centimetres,
    common_columns,
    compare_with_controls,
    count_edits,
    edit_of,
    effect_table,
    is_resolved,
    lines_of,
    mean_of,
    p_of,
    rate,
    share_of_edits,
)
from probe_kit.intervene.kinds.interchange import cells_at
from probe_kit.intervene.outcomes import CLEAN, ConditionOutcomes
from probe_kit.intervene.patching.attribution import LOCALISATION_SHARE
from probe_kit.intervene.patching.patch import Cell
from probe_kit.intervene.places import TILES, resolve_all
from probe_kit.intervene.replay import CLEAN_RUN, Condition, ConditionContext, ConditionResult
from probe_kit.intervene.settings import FIRST_CHUNK
from probe_kit.intervene.stored import Measurement
from probe_kit.runs.run import Run
from probe_kit.statistics.folds import Fold
from probe_kit.statistics.paired_tests import paired_greater_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.sufficiency import SMALLEST_EFFECT_OF_INTEREST

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit._tables.table import Table
    from probe_kit.intervene.directions import TokenFeatures
    from probe_kit.intervene.sessions import ReplaySession

LEACE = "leace"
PROBE_ACCURACY = "probe_accuracy"
"""Entry of the certificate: accuracies of probes behind each condition, by category."""
ErasureFinding = Literal[
    "identity patch", "control", "no baseline effect", "controls also disrupt", "effect", "no effect"
]
UNTOUCHED, ZERO = "none", "0"
"""Direction and coefficient of the condition in which tokens are written back as they are."""
CHANCE_LIKE = 0.6
"""Held-out accuracy below which a probe on two sides is called blind.

Chance is 0.5; an accuracy of a few dozen episodes varies by about 0.1.
"""


# -- the intervention --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ConceptErasure(Intervention):
    """Conditions at every place and role: unchanged, erased, and with matched random subspaces removed instead.

    The eraser of an episode was fitted on the tokens of the other folds' episodes, of the items that are played.

    Attributes:
        sites: Patterns of places of one site each.
        roles: Roles of the erased tokens.
        method: Name of the way to erase, see `erasers.Method`.
        controls: Number of random subspaces of the same rank.
        seed: Seed of controls and folds.

    Raises:
        UsageError: For a method that does not exist, or a role or readout that does not fit.
    """

    kind: ClassVar[str] = "erase"
    summary: ClassVar[str] = "Remove the decodable answer (weaker than interchange)."
    position: ClassVar[int] = 8
    fits_always: ClassVar[bool] = True
    needs_scene: ClassVar[bool] = True
    options: ClassVar[Mapping[str, str]] = {
        "sites": "where tokens are erased, one site each; required",
        "roles": "of the erased tokens; default image",
        "direction": "leace (default), mean-difference:K or inlp:K, K directions per token",
        "controls": "random subspaces of the same rank; default 5",
        "seed": "of controls and folds; default 0",
    }

    sites: tuple[str, ...]
    roles: tuple[str, ...] = ("image",)
    method: str = LEACE  # the command's --direction: what is removed is a direction too
    controls: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.readout != FIRST_CHUNK:
            raise UsageError("what erases is fitted on the first inference; leave --readout out")
        if tiles := set(self.roles) & set(TILES):
            raise UsageError(
                f"{', '.join(sorted(tiles))} is of other patches in every episode, and an eraser is of positions; "
                "erase `image`, or patch the tile (--kind interchange)"
            )
        object.__setattr__(self, "method", str(Method.of(self.method)))

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Return the kind with `direction` as its method.

        Raises:
            UsageError: Without sites.
        """
        if "sites" not in options:
            raise UsageError("--kind erase needs --sites, such as --sites backbone.02")
        method = options.pop("direction", LEACE)
        return super().from_options(run, method=method, **options)

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return clean, then every cell untouched, erased and with its controls.

        The certificate gets, by condition and category, how well a fresh probe reads the answer behind it.

        Raises:
            UnknownSiteError: For a place that does not exist or has several sites.
        """
        from probe_kit.intervene.directions import PassedOver, by_episode, collect_token_features, fit_by_fold

        cells = cells_at(session, resolve_all(self.sites, session.policy).values(), self.roles)
        erasers: dict[Cell, dict[str, dict[str, Eraser]]] = {}
        accuracies: dict[str, dict[str, float]] = {}
        passed_over, method = PassedOver(session, self.sites), Method.of(self.method)
        for cell, category, features in collect_token_features(session, self.items_in(session.run), cells):
            with passed_over.fitting(cell):
                by_name = erasers.setdefault(cell, {})
                fits = fit_by_fold(features, cell, method, self.controls, self.seed, category)
                for name, of_episode in {UNTOUCHED: {}, **by_episode(features, fits)}.items():
                    by_name.setdefault(name, {}).update(of_episode)
                    # What is readable with each eraser, and without; untouched comes first.
                    fitted = [(fold, by_fold[name] if of_episode else None) for fold, by_fold in fits]
                    of_condition = accuracies.setdefault(str(_edited_cell(cell, name)), {})
                    of_condition[category] = _probe_accuracy(features, fitted)
        conditions = [
            erase_cell(cell, name, of_episode)
            for cell, by_name in passed_over.left(erasers).items()
            for name, of_episode in by_name.items()
        ]
        session.certificate[PROBE_ACCURACY] = {
            condition.name: accuracies[condition.name] for condition in conditions
        }
        return [CLEAN_RUN, *conditions]

    @staticmethod
    def effects(measurement: Measurement) -> "list[ErasureEffect]":
        """Return one row per category and condition."""
        accuracies = measurement.certificate.get(PROBE_ACCURACY, {})
        return measurement.rows(lambda part: erasure_effects(part, accuracies))

    @staticmethod
    def table(rows: "Sequence[ErasureEffect]", context: Measurement) -> "Table":
        """Return one line per category and place; controls are columns of the edits compared with them."""
        edits = [row for row in rows if row.finding not in ("control", "identity patch")]
        return effect_table(
            f"What is lost without it? {context.subject}, erase",
            ("category", "erased"),
            lines_of(edits, lambda row: row.name),
            {"What the action does": _ACTION, "What a probe reads": _PROBE},
            lambda row: row.finding == "effect",
            after=["Weaker evidence than interchange"],
        )

    @staticmethod
    def sentence(rows: "Sequence[ErasureEffect]", context: Measurement) -> str:
        """Return which erasures take the answer from the action."""
        del context
        tried, has_answer = _split_erasures(rows)
        if not has_answer:
            return "the unedited action does not go to the correct picture, so that nothing can be lost"
        losses = [f"{row.name} keeps {row.share_left:.2f}" for row in tried if row.finding == "effect"]
        counts = count_edits(losses, len(tried))
        return f"erasures that take the answer from the action beyond their controls: {counts}"

    @staticmethod
    def finding(rows: "Sequence[ErasureEffect]", context: Measurement) -> str:
        """Return whether an erasure takes the answer from the action, and where."""
        del context
        tried, has_answer = _split_erasures(rows)
        if not has_answer:
            return "nothing to lose: the unedited action does not go to the correct picture"
        lost = sorted((row for row in tried if row.finding == "effect"), key=lambda row: row.share_left or 0.0)
        if not lost:
            return (
                f"not lost: none of {len(tried)} erasures takes the answer from the action more than its controls"
            )
        return (
            f"lost: the action no longer follows the answer after {share_of_edits(lost, len(tried), 'erasures')}"
        )

    @staticmethod
    def notes(rows: "Sequence[ErasureEffect]") -> list[str]:
        """Return notes on how weak the evidence is, probes at chance, and controls that disrupt."""
        blind = [row for row in rows if row.finding == "no effect" and (row.probe_accuracy or 1.0) < CHANCE_LIKE]
        broken = [row for row in rows if row.finding == "controls also disrupt"]
        return [
            "Erasure is weaker evidence than interchange: what is read need not be linear, and may pass "
            "elsewhere. Loss beyond the controls is evidence of use. Absence of loss is not evidence against it.",
            *(f"{edit_of(row)}: the probe is at chance, and the action is as before." for row in blind),
            *(f"{edit_of(row)}: random subspaces of the same rank disrupt the action too." for row in broken),
        ]


KIND = ConceptErasure


def _edited_cell(cell: Cell, name: str) -> EditedCell:
    return EditedCell(cell.site_group.name, cell.role, name, ZERO if name == UNTOUCHED else "")


def erase_cell(cell: Cell, name: str, erasers: Mapping[str, Eraser]) -> Condition:
    """Return the clean inference with the tokens of one cell erased.

    Args:
        cell: Cell whose tokens are erased.
        name: Name of the method or the control.
        erasers: By episode, the eraser that was fitted without it; empty to write back the tokens unchanged.
    """

    def play(context: ConditionContext) -> ConditionResult:
        pair, session, site_group = context.pair, context.session, cell.site_group
        tokens = context.tokens.selection(site_group.stream, cell.role)
        change = ApplyEraser(erasers[pair.episode]) if erasers else Identity()
        with apply_patch(session.policy, site_group.sites, tokens, change) as edit_log:
            return ConditionResult(context.act(), edit_log)

    return Condition.of_cell(_edited_cell(cell, name), play)


@dataclass(frozen=True)
class ApplyEraser:
    """An edit that applies an eraser; tokens beyond those that it was fitted on stay as they are."""

    eraser: Eraser

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """Return the activation without the erased part, computed in float64, in which the eraser was fitted."""
        import torch

        del site, where
        fitted = min(activation.shape[1], self.eraser.fitted.size)
        after = activation.clone()
        values = self.eraser(activation[:, :fitted].double().cpu().numpy())
        after[:, :fitted] = torch.from_numpy(values).to(activation)
        return after


def _probe_accuracy(features: "TokenFeatures", fits: Sequence[tuple[Fold, Eraser | None]]) -> float:
    """Return the held-out accuracy of a probe on the mean over tokens, of each fold behind its eraser.

    Chance is one half.
    """
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    right, tokens = 0, features.tokens
    mask = tokens.present[..., None]
    for fold, eraser in fits:
        values = tokens.values if eraser is None else eraser(tokens.values)
        pooled = np.where(mask, values, 0).sum(axis=1) / mask.sum(axis=1)
        probe = make_pipeline(StandardScaler(), LogisticRegression(C=0.01, max_iter=1000))
        probe.fit(pooled[fold.train], features.is_left[fold.train])
        right += int((probe.predict(pooled[fold.test]) == features.is_left[fold.test]).sum())
    return right / features.is_left.size


# -- effects -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ErasureEffect(EffectRow):
    """The effect on the action of erasing an answer at one place, in one category; see `EffectRow`.

    Here `net` is the share of episodes that no longer go to the correct side, minus those that go there only now.

    Attributes:
        right_before: Share of episodes whose action goes to the correct picture's side, without the edit.
        right: The same share with the edit.
        share_left: Share that is left of how far actions go to the correct side. None if they do not go there,
            because a share of noise is noise.
        mean_displacement: Metres away from the correct side.
        control_share_left: Mean `share_left` of the controls; None without any.
        control_net: Mean `net` of the controls; None without any.
        control_displacement: Mean `mean_displacement` of the controls; None without any.
        p: Exact one-sided p-value that an item's action moves away from the correct picture farther than under the
            controls. It is the larger one of by items and by groups; None for rows that are not tested.
        p_fwe: Family-wise p-value of the same, by sign flips of whole groups against the largest t of the
            category; None likewise.
        probe_accuracy_before: Held-out accuracy of a fresh probe on the mean over tokens, without the edit; None
            if not stored.
        probe_accuracy: The same accuracy behind the edit; None if not stored.
    """

    right_before: float
    right: float
    share_left: float | None
    mean_displacement: float
    control_share_left: float | None
    control_net: float | None
    control_displacement: float | None
    p: float | None
    p_fwe: float | None
    probe_accuracy_before: float | None
    probe_accuracy: float | None

    @property
    def finding(self) -> ErasureFinding:
        """The finding: `effect` if, beyond controls and chance, enough of the answer is gone from the action."""
        if self.direction == UNTOUCHED:
            return "identity patch"
        if self.is_control:
            return "control"
        if self.share_left is None:
            return "no baseline effect"
        control_share = 1.0 if self.control_share_left is None else self.control_share_left
        if control_share < LOCALISATION_SHARE:
            return "controls also disrupt"
        is_significant = self.p is not None and self.p < SIGNIFICANCE
        is_large = control_share - self.share_left >= SMALLEST_EFFECT_OF_INTEREST
        return "effect" if is_significant and is_large else "no effect"

    @property
    def name(self) -> str:
        """The edit in a few words."""
        what = "identity patch" if self.direction == UNTOUCHED else self.direction
        return " ".join((self.sites, self.role, what))

    def to_json(self) -> dict[str, Any]:
        """Return plain values and the finding."""
        return {**super().to_json(), "finding": self.finding}


def erasure_effects(
    outcomes: ConditionOutcomes, probe_accuracy: Mapping[str, Mapping[str, float]]
) -> list[ErasureEffect]:
    """Return one row per condition of one category.

    Args:
        outcomes: Outcomes of one category.
        probe_accuracy: Accuracy by condition and category, from the certificate.
    """
    sign, category = outcomes.correct_sign, str(outcomes.categories[0])
    clean = sign * outcomes.of(CLEAN)
    conditions = dict(zip(outcomes.conditions, outcomes.cells, strict=True))
    del conditions[CLEAN]
    cells = list(conditions.values())
    values = np.array([sign * outcomes.of(condition) for condition in conditions])
    away = clean - values
    untouched = [at for at, cell in enumerate(cells) if cell.coefficient]
    tests = compare_with_controls(away, cells, outcomes, skipped=untouched)
    goes_there = paired_greater_p(clean, outcomes.items, outcomes.groups) < SIGNIFICANCE
    share = values.sum(axis=1) / clean.sum() if goes_there else None
    net = (clean > 0).astype(float) - (values > 0)
    rows = []
    for at, ((condition, cell), test) in enumerate(zip(conditions.items(), tests, strict=True)):
        before = str(EditedCell(cell.site, cell.role, UNTOUCHED, ZERO))
        rows.append(
            ErasureEffect(
                **common_columns(outcomes, outcomes.conditions.index(condition), cell, net[at]),
                right_before=float((clean > 0).mean()),
                right=float((values[at] > 0).mean()),
                share_left=None if share is None else float(share[at]),
                mean_displacement=float(away[at].mean()),
                control_share_left=None if share is None else mean_of(share[test.controls]),
                control_net=mean_of(net.mean(axis=1)[test.controls]),
                control_displacement=mean_of(away.mean(axis=1)[test.controls]),
                p=None if test.beyond is None else paired_greater_p(test.beyond, outcomes.items, outcomes.groups),
                p_fwe=test.p_fwe,
                probe_accuracy_before=probe_accuracy.get(before, {}).get(category),
                probe_accuracy=probe_accuracy.get(condition, {}).get(category),
            )
        )
    return rows


def _split_erasures(rows: Sequence[ErasureEffect]) -> tuple[list[ErasureEffect], bool]:
    """Return the erasures without identity patches, and whether the unedited action has an answer to lose."""
    tried = [row for row in rows if row.finding != "identity patch"]
    return tried, not tried or any(row.finding != "no baseline effect" for row in tried)


def _accuracies(row: ErasureEffect) -> TableCell:
    if row.probe_accuracy_before is None or row.probe_accuracy is None:
        return TableCell(None)
    return TableCell(row.probe_accuracy_before, percent, after=f" → {percent(row.probe_accuracy)}")


_ACTION = (
    EffectColumn[ErasureEffect](
        "goes there %",
        lambda row: TableCell(row.right_before, percent, after=f" → {percent(row.right)}"),
        "goes there: share of episodes whose action goes to the correct picture",
    ),
    EffectColumn[ErasureEffect](
        "controls %", lambda row: rate(None if row.control_net is None else row.right_before - row.control_net)
    ),
    EffectColumn[ErasureEffect](
        "kept",
        lambda row: absent("n/a") if row.share_left is None else TableCell(row.share_left, number),
        "kept: share of its distance toward the correct picture that is left, n/a where it does not go there",
    ),
    EffectColumn[ErasureEffect](
        "controls",
        lambda row: TableCell(row.control_share_left, number),
        "controls: the mean of random subspaces of the same rank",
    ),
    EffectColumn[ErasureEffect]("displacement cm", lambda row: centimetres(-row.mean_displacement, with_sign)),
    EffectColumn[ErasureEffect](
        "p",
        lambda row: p_of(row.p, is_resolved(100 * row.mean_displacement, row.right_before - row.right)),
        "p: exact, of a larger move away from the correct picture than under the controls; the larger of the "
        "tests by item and by group",
    ),
    EffectColumn[ErasureEffect](
        "relative change",
        lambda row: TableCell(row.relative_change, number),
        "relative change: how far tokens were moved, as a share of their norm",
    ),
)
_PROBE = (
    EffectColumn[ErasureEffect](
        "probe accuracy %", _accuracies, "probe accuracy: a fresh probe on the mean over tokens"
    ),
    EffectColumn[ErasureEffect]("finding", lambda row: row.finding),
)
