"""Erasing: what is linearly readable of the answer taken away, token by token, beside random controls.

A supplement, and the weakest of them. What a policy reads need not be linear, an answer that is erased at one
place may pass at another, and what is taken away along with it breaks the hand: a place where an exchange passes
tells more than a place where an eraser breaks something. Erasers that know only the mean over tokens blind a probe
and leave the behaviour, so that there is one per position.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.edits.linear_erasure import Eraser, Method, Tokens
from probe_kit.intervene.edits.patching import Kept, Where, patched
from probe_kit.intervene.edits.sites import Place, places, roles_of
from probe_kit.intervene.replay.conditions import Condition, Intervention, Plain, Played, Replayed, Turn
from probe_kit.intervene.replay.image_tokens import TILES, role_tokens
from probe_kit.intervene.replay.session import Bench
from probe_kit.intervene.replay.token_features import Gathered, by_episode, fit_by_fold, gather
from probe_kit.intervene.store.answers import ERASE, READABLE
from probe_kit.intervene.store.settings import CHUNK, items_of
from probe_kit.statistics.folds import Fold

if TYPE_CHECKING:
    from torch import Tensor

LEACE, UNTOUCHED = "leace", "none|0"


@dataclass(frozen=True, kw_only=True)
class Erase(Intervention):
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
        if self.readout != CHUNK:
            raise UsageError("what erases is fitted on the first inference; leave --readout out")
        if not self.sites or not self.roles:
            raise UsageError("erasing needs at least one site and one role")
        if tiles := set(self.roles) & set(TILES):
            raise UsageError(
                f"{', '.join(sorted(tiles))} is of other patches in every episode, and an eraser is of positions; "
                "erase `image`, or exchange the tile (--kind interchange)"
            )
        object.__setattr__(self, "method", str(Method.of(self.method)))

    @property
    def kind(self) -> str:
        """`erase`."""
        return ERASE

    @property
    def learns(self) -> bool:
        """Always."""
        return True

    def own_settings(self) -> dict[str, Any]:
        """Where, how and beside how many controls."""
        return {
            "sites": list(self.sites), "roles": list(self.roles), "method": self.method,
            "controls": self.controls, "seed": self.seed,
        }  # fmt: skip

    def conditions(self, bench: Bench) -> Sequence[Condition]:
        """Plain, then every place and role at dose 0, erased, and with its controls. Raises UnknownSiteError."""
        found = {place.name: place for pattern in self.sites for place in places(pattern, bench.policy)}
        wanted = {place: roles_of(bench.policy, place.stream, self.roles) for place in found.values()}
        if not any(wanted.values()):
            raise UsageError(f"no token of {', '.join(found)} plays {', '.join(self.roles)}")
        cells: dict[tuple[Place, str], _Cell] = {}
        for place, role, category, own in gather(bench, items_of(bench.run, self), wanted):
            self._fit(cells.setdefault((place, role), _Cell()), place, role, category, own)
        return [Plain(), *(erased for (place, role), cell in cells.items() for erased in cell.at(place, role))]

    def told(self, conditions: Sequence[Condition], found: Replayed) -> dict[str, Any]:
        """How well a fresh probe reads the answer behind each condition, by category."""
        del found
        return {READABLE: {one.name: dict(one.readable) for one in conditions if isinstance(one, Erased)}}

    def _fit(self, cell: "_Cell", place: Place, role: str, category: str, own: Gathered) -> None:
        """Add one category's erasers, and what is readable with each and without."""
        fits = fit_by_fold(own, place.only_site, role, Method.of(self.method), self.controls, self.seed, category)
        folds = [fold for fold, _ in fits]
        cell.readable.setdefault(UNTOUCHED, {})[category] = _readable(own, folds, None)
        for name, of_episode in by_episode(own, fits).items():
            cell.erasers.setdefault(name, {}).update(of_episode)
            fitted = [by_name[name] for _, by_name in fits]
            cell.readable.setdefault(name, {})[category] = _readable(own, folds, fitted)


@dataclass(frozen=True)
class Erased:
    """The tokens of one role at one place, without what an eraser takes away.

    erasers: by episode, fitted without it; empty to write back what is there. readable: by category, the held-out
    accuracy of a probe fitted on what is left, of the mean over tokens.
    """

    place: Place
    role: str
    what: str
    erasers: Mapping[str, Eraser] = field(repr=False)
    readable: Mapping[str, float]

    @property
    def name(self) -> str:
        """Place, role and what is taken away, apart by `|`."""
        return f"{self.place.name}|{self.role}|{self.what}"

    def play(self, turn: Turn) -> Played:
        """The plain inference without it."""
        question, bench = turn.question, turn.bench
        tokens = role_tokens(bench.policy, question, self.place.stream, self.role, turn.memo)
        change = Without(self.erasers[question.episode_id]) if self.erasers else Kept()
        with patched(bench.policy, self.place.sites, tokens, change) as ledger:
            chunk = bench.act(question.seen, question.seed)
        return Played(chunk, ledger)


@dataclass
class _Cell:
    """One place and role. erasers: by name and episode. readable: by name and category."""

    erasers: dict[str, dict[str, Eraser]] = field(default_factory=dict)
    readable: dict[str, dict[str, float]] = field(default_factory=dict)

    def at(self, place: Place, role: str) -> list[Erased]:
        """Untouched first, then every eraser."""
        return [Erased(place, role, name, self.erasers.get(name, {}), own) for name, own in self.readable.items()]


@dataclass(frozen=True)
class Without:
    """What an eraser leaves; tokens beyond those it was fitted on stay as they are."""

    eraser: Eraser

    def __call__(self, site: Site, own: "Tensor", where: Where) -> "Tensor":
        """Computed in float64, as it was fitted."""
        import torch

        del site, where
        known = min(own.shape[1], self.eraser.fitted.size)
        after = own.clone()
        erased = self.eraser(own[:, :known].double().cpu().numpy())
        after[:, :known] = torch.from_numpy(erased).to(own)
        return after


def _readable(own: Gathered, folds: Sequence[Fold], erasers: Sequence[Eraser] | None) -> float:
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


def _pooled(tokens: Tokens, eraser: Eraser | None) -> NDArray[np.float64]:
    """(N, D) mean over the tokens that are there."""
    values = tokens.values if eraser is None else eraser(tokens.values)
    here = tokens.present[..., None]
    return np.asarray(np.where(here, values, 0).sum(axis=1) / here.sum(axis=1))
