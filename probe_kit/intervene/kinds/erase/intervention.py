"""Concept erasure: the linearly decodable answer is removed from each token, with random controls.

A supplement, and the weakest. What a policy reads need not be linear, an answer that is erased at one place may
pass at another, and what is removed along with it disrupts the task. Erasers that know only the mean over tokens
blind a probe and leave the behaviour, so that there is one per position.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.extract.store.run import Run
from probe_kit.hooks.capturing.edit_engine import apply_patch
from probe_kit.hooks.capturing.token_edits import Identity, TokenIndex
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.edits.linear_erasure import Eraser, Method, PaddedTokens
from probe_kit.intervene.edits.sites import SiteGroup, resolve_sites, roles_of
from probe_kit.intervene.kinds.base import ConditionName
from probe_kit.intervene.kinds.erase.effects import UNTOUCHED, ZERO
from probe_kit.intervene.replay.conditions import (
    CleanRun,
    Condition,
    ConditionContext,
    ConditionResult,
    Intervention,
    ReplayBatch,
)
from probe_kit.intervene.replay.image_tokens import TILES, role_tokens
from probe_kit.intervene.replay.session import ReplaySession
from probe_kit.intervene.replay.token_features import (
    TokenFeatures,
    by_episode,
    collect_token_features,
    fit_by_fold,
)
from probe_kit.intervene.store.answers import ERASE, PROBE_ACCURACY
from probe_kit.intervene.store.settings import FIRST_CHUNK, items_of
from probe_kit.statistics.folds import Fold

if TYPE_CHECKING:
    from torch import Tensor

LEACE = "leace"


@dataclass(frozen=True, kw_only=True)
class ConceptErasure(Intervention):
    """Every place and role: written back as it was, erased, and with matched random subspaces taken away instead.

    sites: patterns of places of one site each. roles: whose tokens. method: see `train.erasure.Method`. controls:
    so many of the same rank. What erases an episode was fitted on the tokens of the other folds' episodes, of the
    items that are played. Raises UsageError for a method that does not exist.
    """

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
        """`direction` is its method. Raises UsageError without sites."""
        if "sites" not in options:
            raise UsageError("--kind erase needs --sites, such as --sites backbone.02")
        method = options.pop("direction", LEACE)
        return super().from_options(run, method=method, **options)

    @property
    def kind(self) -> str:
        """`erase`."""
        return ERASE

    @property
    def fits_first(self) -> bool:
        """Always."""
        return True

    def parameters(self) -> dict[str, Any]:
        """Where, how and beside how many controls."""
        return {
            "sites": list(self.sites), "roles": list(self.roles), "method": self.method,
            "controls": self.controls, "seed": self.seed,
        }  # fmt: skip

    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """Clean, then every place and role untouched, erased and with its controls. Raises UnknownSiteError."""
        found = {place.name: place for pattern in self.sites for place in resolve_sites(pattern, session.policy)}
        wanted = {place: roles_of(session.policy, place.stream, self.roles) for place in found.values()}
        if not any(wanted.values()):
            raise UsageError(f"no token of {', '.join(found)} has the role {', '.join(self.roles)}")
        cells: dict[tuple[SiteGroup, str], _FittedErasers] = {}
        for place, role, category, own in collect_token_features(session, items_of(session.run, self), wanted):
            self._fit(cells.setdefault((place, role), _FittedErasers()), place, role, category, own)
        return [CleanRun(), *(erased for (place, role), cell in cells.items() for erased in cell.at(place, role))]

    def certificate_entries(self, conditions: Sequence[Condition], found: ReplayBatch) -> dict[str, Any]:
        """How well a fresh probe reads the answer behind each condition, by category."""
        del found
        return {
            PROBE_ACCURACY: {
                one.name: dict(one.probe_accuracy) for one in conditions if isinstance(one, ErasedCondition)
            }
        }

    def _fit(self, cell: "_FittedErasers", place: SiteGroup, role: str, category: str, own: TokenFeatures) -> None:
        """Add one category's erasers, and what is readable with each and without."""
        fits = fit_by_fold(own, place.only_site, role, Method.of(self.method), self.controls, self.seed, category)
        folds = [fold for fold, _ in fits]
        cell.probe_accuracy.setdefault(UNTOUCHED, {})[category] = _probe_accuracy(own, folds, None)
        for name, of_episode in by_episode(own, fits).items():
            cell.erasers.setdefault(name, {}).update(of_episode)
            fitted = [by_name[name] for _, by_name in fits]
            cell.probe_accuracy.setdefault(name, {})[category] = _probe_accuracy(own, folds, fitted)


@dataclass(frozen=True)
class ErasedCondition:
    """The tokens of one role at one place, without what an eraser takes away.

    erasers: by episode, fitted without it; empty to write back what is there. readable: by category, the held-out
    accuracy of a probe fitted on what is left, of the mean over tokens.
    """

    place: SiteGroup
    role: str
    what: str
    erasers: Mapping[str, Eraser] = field(repr=False)
    probe_accuracy: Mapping[str, float]

    @property
    def name(self) -> str:
        """See `ConditionName`."""
        coefficient = ZERO if self.what == UNTOUCHED else ""
        return str(ConditionName(self.place.name, self.role, self.what, coefficient))

    def play(self, context: ConditionContext) -> ConditionResult:
        """The clean inference without it."""
        replay_input, session = context.replay_input, context.session
        tokens = role_tokens(session.policy, replay_input, self.place.stream, self.role, context.memo)
        change = ApplyEraser(self.erasers[replay_input.episode_id]) if self.erasers else Identity()
        with apply_patch(session.policy, self.place.sites, tokens, change) as edit_log:
            chunk = session.act(replay_input.seen, replay_input.seed)
        return ConditionResult(chunk, edit_log)


@dataclass
class _FittedErasers:
    """One place and role. erasers: by name and episode. readable: by name and category."""

    erasers: dict[str, dict[str, Eraser]] = field(default_factory=dict)
    probe_accuracy: dict[str, dict[str, float]] = field(default_factory=dict)

    def at(self, place: SiteGroup, role: str) -> list[ErasedCondition]:
        """Untouched first, then every eraser."""
        return [
            ErasedCondition(place, role, name, self.erasers.get(name, {}), own)
            for name, own in self.probe_accuracy.items()
        ]


@dataclass(frozen=True)
class ApplyEraser:
    """What an eraser leaves; tokens beyond those it was fitted on stay as they are."""

    eraser: Eraser

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """Computed in float64, as it was fitted."""
        import torch

        del site, where
        known = min(own.shape[1], self.eraser.fitted.size)
        after = own.clone()
        erased = self.eraser(own[:, :known].double().cpu().numpy())
        after[:, :known] = torch.from_numpy(erased).to(own)
        return after


def _probe_accuracy(own: TokenFeatures, folds: Sequence[Fold], erasers: Sequence[Eraser] | None) -> float:
    """Held-out accuracy of a probe on the mean over tokens; chance is one half."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    right = 0
    for number, fold in enumerate(folds):
        pooled = _pooled(own.tokens, None if erasers is None else erasers[number])
        probe = make_pipeline(StandardScaler(), LogisticRegression(C=0.01, max_iter=1000))
        probe.fit(pooled[fold.train], own.left[fold.train])
        right += int((probe.predict(pooled[fold.test]) == own.left[fold.test]).sum())
    return right / own.left.size


def _pooled(tokens: PaddedTokens, eraser: Eraser | None) -> NDArray[np.float64]:
    """(N, D) mean over the tokens that are there."""
    values = tokens.values if eraser is None else eraser(tokens.values)
    here = tokens.present[..., None]
    return np.asarray(np.where(here, values, 0).sum(axis=1) / here.sum(axis=1))
