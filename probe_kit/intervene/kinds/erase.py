"""Concept erasure: the linearly decodable answer is removed from each token, with random controls.

Holds the intervention, its effects and their table. The fits are in `erasers`, which interchange and
steer share with it (`--direction mean-difference:K`). Erasure is a supplement, and the weakest. A policy may read
what is not linear. An answer that is erased at one place may pass at another, and what is removed along with it
disrupts the task. Erasers that know only the mean over tokens blind a probe and leave the behaviour, so that there
is one per position.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.capturing.edits import Identity, TokenIndex, apply_patch
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.erasers import Eraser, Method, PaddedTokens
from probe_kit.intervene.kinds.base import (
    ConditionName,
    EffectRow,
    Intervention,
    Measurement,
    TableContext,
    common_columns,
    count_edits,
    edit_of,
    effect_table,
    lines_of,
    mean_of,
    share_of_edits,
    test_against_controls,
    text_of,
)
from probe_kit.intervene.kinds.image_swap import net_interval
from probe_kit.intervene.kinds.interchange import cells_at
from probe_kit.intervene.outcomes import CLEAN, ERASE, FIRST_CHUNK, PROBE_ACCURACY, ConditionOutcomes
from probe_kit.intervene.patching.attribution import LOCALISATION_SHARE
from probe_kit.intervene.patching.patch import Cell
from probe_kit.intervene.places import TILES, resolve_all, role_tokens
from probe_kit.intervene.replay import CleanRun, Condition, ConditionContext, ConditionResult, ReplayBatch
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
Finding = Literal[
    "identity patch", "control", "no baseline effect", "controls also disrupt", "effect", "no effect"
]
ProbeAccuracies = Mapping[str, Mapping[str, float]]
"""By condition and category."""
_NOTHING: ProbeAccuracies = {}
UNTOUCHED, ZERO = "none", "0"
"""Direction and coefficient of the condition in which tokens are written back as they are."""
CHANCE_LIKE = 0.6
"""Held-out accuracy below which a probe on two sides is said to be blind."""
_LEGEND = (
    "goes there: share of episodes whose action goes to the correct picture; kept: of how far, n/a where it does "
    "not; controls: the mean of random subspaces of the same rank; p: exact, that the action moves away farther "
    "than under the controls, by item and by group, the larger one; probe accuracy: a fresh probe on the mean "
    "over tokens; relative change: how far tokens were moved, in their own norms. Weaker evidence than interchange"
)


# -- the intervention --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ConceptErasure(Intervention):
    """Every place and role: written back as it was, erased, and with matched random subspaces taken away instead.

    sites: patterns of places of one site each. roles: whose tokens. method: see `erasers.Method`. controls:
    so many of the same rank. What erases an episode was fitted on the tokens of the other folds' episodes, of the
    items that are played. Raises UsageError for a method that does not exist.
    """

    kind: ClassVar[str] = ERASE
    summary: ClassVar[str] = "Remove the decodable answer (weaker than interchange)."
    position: ClassVar[int] = 8
    needs_sides: ClassVar[bool] = True
    options: ClassVar[Mapping[str, str]] = {
        "sites": "where tokens are erased, one site each; required",
        "roles": "of the erased tokens; default image",
        "direction": "leace (default), mean-difference:K or inlp:K, K directions per token",
        "controls": "random subspaces of the same rank; default 5",
        "seed": "of controls and folds; default 0",
    }

    sites: tuple[str, ...]
    roles: tuple[str, ...] = ("image",)
    method: str = LEACE
    controls: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.readout != FIRST_CHUNK:
            raise UsageError("what erases is fitted on the first inference; leave --readout out")
        if not self.sites or not self.roles:
            raise UsageError("erasing needs at least one site and one role")
        if tiles := set(self.roles) & set(TILES):
            raise UsageError(
                f"{', '.join(sorted(tiles))} is of other patches in every episode, and an eraser is of positions; "
                "erase `image`, or patch the tile (--kind interchange)"
            )
        object.__setattr__(self, "method", str(Method.of(self.method)))

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Return it with `direction` as its method. Raises UsageError without sites."""
        if "sites" not in options:
            raise UsageError("--kind erase needs --sites, such as --sites backbone.02")
        method = options.pop("direction", LEACE)
        return super().from_options(run, method=method, **options)

    @property
    def fits_first(self) -> bool:
        """Whether erasers are fitted first: always."""
        return True

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return clean, then every cell untouched, erased and with its controls. Raises UnknownSiteError."""
        from probe_kit.intervene.directions import PassedOver, collect_token_features

        places = resolve_all(self.sites, session.policy)
        cells = cells_at(session, places.values(), self.roles)
        if not cells:
            raise UsageError(f"no token of {', '.join(places)} has the role {', '.join(self.roles)}")
        erased: dict[Cell, dict[str, ErasedCondition]] = {}
        passed_over = PassedOver(session, self.sites)
        for cell, category, features in collect_token_features(session, self.items_in(session.run), cells):
            with passed_over.fitting(cell):
                self._fit(erased.setdefault(cell, {}), cell, category, features)
        return [
            CleanRun(),
            *(condition for by_name in passed_over.left(erased).values() for condition in by_name.values()),
        ]

    def certificate_entries(self, conditions: Sequence[Condition], batch: ReplayBatch) -> dict[str, Any]:
        """Return how well a fresh probe reads the answer behind each condition, by category."""
        del batch
        erased = [condition for condition in conditions if isinstance(condition, ErasedCondition)]
        return {PROBE_ACCURACY: {condition.name: dict(condition.probe_accuracy) for condition in erased}}

    def _fit(
        self, by_name: "dict[str, ErasedCondition]", cell: Cell, category: str, features: "TokenFeatures"
    ) -> None:
        """Add one category's erasers, and what is readable with each and without; untouched comes first."""
        from probe_kit.intervene.directions import by_episode, fit_by_fold

        fits = fit_by_fold(features, cell, Method.of(self.method), self.controls, self.seed, category)
        folds = [fold for fold, _ in fits]
        erasers: dict[str, dict[str, Eraser]] = {UNTOUCHED: {}, **by_episode(features, fits)}
        for name, of_episode in erasers.items():
            condition = by_name.setdefault(name, ErasedCondition(cell, name, {}, {}))
            condition.erasers.update(of_episode)
            fitted = [by_fold[name] for _, by_fold in fits] if of_episode else None
            condition.probe_accuracy[category] = _probe_accuracy(features, folds, fitted)

    @staticmethod
    def effects(measurement: Measurement) -> "list[ErasureEffect]":
        """Return one per category and condition."""
        accuracies = measurement.certificate.get(PROBE_ACCURACY, {})
        return erasure_effects(measurement.outcomes, measurement.seed_text, measurement.key, accuracies)

    @staticmethod
    def table(rows: "Sequence[ErasureEffect]", context: TableContext) -> "Table":
        """Return one line per category and place; controls are columns of what is compared with them."""
        edits = [row for row in rows if row.finding not in ("control", "identity patch")]
        return effect_table(
            f"What is lost without it? {context.subject}, erase",
            _LEGEND,
            ("category", "erased"),
            lines_of(edits, lambda row: row.name),
            {"What the action does": _ACTION, "What a probe reads": _PROBE},
            lambda row: row.finding == "effect",
        )

    @staticmethod
    def sentence(rows: "Sequence[ErasureEffect]") -> str:
        """Return which erasures take the answer from the action."""
        tried, has_answer = _tried(rows)
        if not has_answer:
            return "the unedited action does not go to the correct picture, so that nothing can be lost"
        losses = [f"{row.name} keeps {row.kept:.2f}" for row in tried if row.finding == "effect"]
        counts = count_edits(losses, len(tried))
        return f"erasures that take the answer from the action beyond their controls: {counts}"

    @staticmethod
    def finding(rows: "Sequence[ErasureEffect]", context: TableContext) -> str:
        """Return whether an erasure takes the answer from the action, and where."""
        del context
        tried, has_answer = _tried(rows)
        if not has_answer:
            return "nothing to lose: the unedited action does not go to the correct picture"
        lost = sorted((row for row in tried if row.finding == "effect"), key=lambda row: row.kept or 0.0)
        if not lost:
            return f"not lost: no erasure of {len(tried)} takes the answer from the action beyond its controls"
        return f"lost: the action leaves the answer after {share_of_edits(lost, len(tried), 'erasures')}"

    @staticmethod
    def notes(rows: "Sequence[ErasureEffect]", measurement: Measurement) -> list[str]:
        """Return how weak the evidence is, probes at chance, and controls that disrupt."""
        del measurement
        blind = [row for row in rows if row.finding == "no effect" and (row.probe_accuracy or 1.0) < CHANCE_LIKE]
        broken = [row for row in rows if row.finding == "controls also disrupt"]
        return [
            "Erasure is weaker evidence than interchange: what is read need not be linear, and may pass "
            "elsewhere. Loss beyond the controls is evidence of use. Absence of loss is not evidence against it.",
            *(f"{edit_of(row)}: the probe is at chance, and the action is as before." for row in blind),
            *(f"{edit_of(row)}: random subspaces of the same rank disrupt the action too." for row in broken),
        ]


KIND = ConceptErasure


@dataclass(frozen=True)
class ErasedCondition:
    """The tokens of one cell, without what an eraser takes away.

    erasers: by episode, fitted without it; empty to write back what is there. probe_accuracy: by category, the
    held-out accuracy of a probe fitted on what is left, of the mean over tokens.
    """

    cell: Cell
    direction: str
    erasers: dict[str, Eraser] = field(repr=False)
    probe_accuracy: dict[str, float]

    @property
    def name(self) -> str:
        """Return place, role and direction, see `ConditionName`."""
        coefficient = ZERO if self.direction == UNTOUCHED else ""
        return str(ConditionName(self.cell.site_group.name, self.cell.role, self.direction, coefficient))

    def play(self, context: ConditionContext) -> ConditionResult:
        """Infer without it."""
        pair, session, site_group = context.pair, context.session, self.cell.site_group
        tokens = role_tokens(session.policy, pair, site_group.stream, self.cell.role, context.memo)
        change = ApplyEraser(self.erasers[pair.episode]) if self.erasers else Identity()
        with apply_patch(session.policy, site_group.sites, tokens, change) as edit_log:
            chunk = session.act(pair.clean, pair.seed)
        return ConditionResult(chunk, edit_log)


@dataclass(frozen=True)
class ApplyEraser:
    """An edit that leaves what an eraser leaves; tokens beyond those it was fitted on stay as they are."""

    eraser: Eraser

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """Computed in float64, as it was fitted."""
        import torch

        del site, where
        fitted = min(activation.shape[1], self.eraser.fitted.size)
        after = activation.clone()
        erased = self.eraser(activation[:, :fitted].double().cpu().numpy())
        after[:, :fitted] = torch.from_numpy(erased).to(activation)
        return after


def _probe_accuracy(features: "TokenFeatures", folds: Sequence[Fold], erasers: Sequence[Eraser] | None) -> float:
    """Held-out accuracy of a probe on the mean over tokens; chance is one half."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    right = 0
    for number, fold in enumerate(folds):
        pooled = _pooled(features.tokens, None if erasers is None else erasers[number])
        probe = make_pipeline(StandardScaler(), LogisticRegression(C=0.01, max_iter=1000))
        probe.fit(pooled[fold.train], features.is_left[fold.train])
        right += int((probe.predict(pooled[fold.test]) == features.is_left[fold.test]).sum())
    return right / features.is_left.size


def _pooled(tokens: PaddedTokens, eraser: Eraser | None) -> NDArray[np.float64]:
    """(N, D) mean over the tokens that are there."""
    values = tokens.values if eraser is None else eraser(tokens.values)
    mask = tokens.present[..., None]
    return np.asarray(np.where(mask, values, 0).sum(axis=1) / mask.sum(axis=1))


# -- effects -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ErasureEffect(EffectRow):
    """The effect on the action of erasing an answer at one place, in one category; see `EffectRow`.

    right_before, right: share of episodes whose action goes to the correct picture's side, without and with the
    edit. kept: of how far actions go to the correct side, the share that is left; None if they do not go there,
    because a share of noise is noise. net: share of episodes that no longer go there minus those that do now.
    mean_displacement: metres away from the correct side. control_kept, control_net, control_displacement: means of
    the controls. p: exact and one-sided, that an item's action moves away from the correct picture farther than
    under the controls, by items and by groups, the larger one. p_fwe: of the same, by sign flips of whole groups
    against the largest t of the category. probe_accuracy_before, probe_accuracy: held-out accuracy of a fresh
    probe on the mean over tokens.
    """

    right_before: float
    right: float
    kept: float | None
    mean_displacement: float
    control_kept: float | None
    control_net: float | None
    control_displacement: float | None
    p: float | None
    p_fwe: float | None
    probe_accuracy_before: float | None
    probe_accuracy: float | None

    @property
    def finding(self) -> Finding:
        """`effect` if, beyond its controls and chance, enough of the answer is gone from the action."""
        if self.direction == UNTOUCHED:
            return "identity patch"
        if self.is_control:
            return "control"
        if self.kept is None:
            return "no baseline effect"
        control_share = 1.0 if self.control_kept is None else self.control_kept
        if control_share < LOCALISATION_SHARE:
            return "controls also disrupt"
        gone = (
            self.p is not None
            and self.p < SIGNIFICANCE
            and control_share - self.kept >= SMALLEST_EFFECT_OF_INTEREST
        )
        return "effect" if gone else "no effect"

    @property
    def name(self) -> str:
        """Return the edit in a few words."""
        what = "identity patch" if self.direction == UNTOUCHED else self.direction
        return " ".join((self.place, self.role, what))

    def to_json(self) -> dict[str, Any]:
        """Plain values and the finding."""
        return {**super().to_json(), "finding": self.finding}


def erasure_effects(
    outcomes: ConditionOutcomes, seed_text: str, key: str = "", probe_accuracy: ProbeAccuracies = _NOTHING
) -> list[ErasureEffect]:
    """One per category and condition. probe_accuracy: as a certificate has it."""
    return [
        row
        for category, part in outcomes.by_category()
        for row in _of_category(part, category, seed_text, key, probe_accuracy)
    ]


def _of_category(
    outcomes: ConditionOutcomes, category: str, seed_text: str, key: str, probe_accuracy: ProbeAccuracies
) -> list[ErasureEffect]:
    sign = outcomes.correct_sign
    clean = sign * outcomes.of(CLEAN)
    conditions = [name for name in outcomes.conditions if name != CLEAN]
    names = [ConditionName.parse(condition) for condition in conditions]
    values = np.array([sign * outcomes.of(condition) for condition in conditions])
    away = clean - values
    untouched = [at for at, name in enumerate(names) if name.coefficient]
    tests = test_against_controls(away, names, outcomes, seed_text, untouched, ())
    goes_there = paired_greater_p(clean, outcomes.items, outcomes.groups) < SIGNIFICANCE
    share = values.sum(axis=1) / clean.sum() if goes_there else None
    net = (clean > 0).astype(float) - (values > 0)
    rows = []
    for at, (condition, name, test) in enumerate(zip(conditions, names, tests, strict=True)):
        columns: dict[str, Any] = common_columns(outcomes, outcomes.conditions.index(condition), name)
        before = str(ConditionName(name.site, name.role, UNTOUCHED, ZERO))
        rows.append(
            ErasureEffect(
                category=category,
                **columns,
                right_before=float((clean > 0).mean()),
                right=float((values[at] > 0).mean()),
                kept=None if share is None else float(share[at]),
                net=float(net[at].mean()),
                net_ci=net_interval(net[at], outcomes, seed_text),
                mean_displacement=float(away[at].mean()),
                control_kept=None if share is None else mean_of(share[test.controls]),
                control_net=mean_of(net.mean(axis=1)[test.controls]),
                control_displacement=mean_of(away.mean(axis=1)[test.controls]),
                p=None if test.beyond is None else paired_greater_p(test.beyond, outcomes.items, outcomes.groups),
                p_fwe=test.p_fwe,
                probe_accuracy_before=probe_accuracy.get(before, {}).get(category),
                probe_accuracy=probe_accuracy.get(condition, {}).get(category),
                key=key,
            )
        )
    return rows


def _tried(rows: Sequence[ErasureEffect]) -> tuple[list[ErasureEffect], bool]:
    """Return the erasures but for identity patches, and whether the unedited action has an answer to lose."""
    tried = [row for row in rows if row.finding != "identity patch"]
    return tried, not tried or any(row.finding != "no baseline effect" for row in tried)


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f}"


def _accuracies(row: ErasureEffect) -> str:
    if row.probe_accuracy_before is None or row.probe_accuracy is None:
        return "–"
    return f"{_percent(row.probe_accuracy_before)} → {_percent(row.probe_accuracy)}"


_ACTION: Mapping[str, Any] = {
    "goes there %": lambda row: f"{_percent(row.right_before)} → {_percent(row.right)}",
    "controls %": lambda row: _percent(None if row.control_net is None else row.right_before - row.control_net),
    "kept": lambda row: text_of(row.kept, missing="n/a"),
    "controls": lambda row: text_of(row.control_kept),
    "displacement cm": lambda row: f"{-100 * row.mean_displacement:+.2f}",
    "p": lambda row: text_of(row.p, ".2g"),
    "relative change": lambda row: f"{row.relative_change:.2f}",
}
_PROBE: Mapping[str, Any] = {"probe accuracy %": _accuracies, "finding": lambda row: row.finding}
