"""Interchange: one part of the stream taken from the same inference before exchanged pictures.

What is put in is what this very policy has there in this very state, so it lies where streams lie, has no dose,
and can do no more than the exchange itself: with all that differs put in, the effect is 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.hooks.contract.sites import MEMORY_STREAM, Site
from probe_kit.intervene.edits.patching import Change, Replaced, ReplacedAlong, patched
from probe_kit.intervene.edits.sites import ALL, Place, places, roles_of
from probe_kit.intervene.replay.conditions import Condition, Exchanged, Intervention, Plain, Played, Turn
from probe_kit.intervene.replay.image_tokens import TILES, role_tokens
from probe_kit.intervene.replay.session import Bench
from probe_kit.intervene.replay.token_directions import Bases, bases_of, check_direction
from probe_kit.intervene.store.settings import items_of

if TYPE_CHECKING:
    from probe_kit.hooks import ActivationCache

SITES = ("backbone.*",)
ROLES = (ALL, "image", "language")
NONE = "none"


def needed(sites: Sequence[str], roles: Sequence[str]) -> tuple[InterventionKind, ...]:
    """What a family must support for changes at such places and roles."""
    memory = any(pattern.partition(".")[0] == MEMORY_STREAM for pattern in sites)
    further: dict[InterventionKind, bool] = {"memory": memory, "tiles": bool(set(roles) & set(TILES))}
    return ("edit", *(kind for kind, is_needed in further.items() if is_needed))


@dataclass(frozen=True, kw_only=True)
class Interchange(Intervention):
    """Every place is tried at every role, alone.

    sites: patterns of places, see `places`. roles: of the tokens that are taken over; a stream is tried at those
    that it has. direction: `none` takes tokens over whole; `mean-difference` or `probe` only along that direction
    of each place (rank 1), found in means over tokens without the episode it is used on; `mean-difference:K` along
    K directions found in the tokens themselves, see `token_directions`. controls: so many times as many random
    directions of the data's own covariance, orthogonal to it, per place and role.
    """

    sites: tuple[str, ...] = SITES
    roles: tuple[str, ...] = ROLES
    direction: str = NONE
    controls: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sites or not self.roles:
            raise UsageError("an interchange needs at least one site and one role")
        if set(self.roles) & set(TILES) and self.direction != NONE:
            raise UsageError(
                "tiles have no mean in the run from which a direction could be found; exchange them whole: leave "
                "--direction out"
            )
        if self.direction != NONE:
            check_direction(self.direction)
        elif self.controls:
            raise UsageError("controls are directions beside another one; choose --direction, or no --controls")

    @property
    def kind(self) -> str:
        """`interchange`."""
        return "interchange"

    @property
    def needs(self) -> tuple[InterventionKind, ...]:
        """Edits; and a memory, where one of its places is."""
        return needed(self.sites, self.roles)

    @property
    def learns(self) -> bool:
        """Where its direction is of tokens."""
        return ":" in self.direction

    def own_settings(self) -> dict[str, Any]:
        """Where, which tokens and along what."""
        return {
            "sites": list(self.sites), "roles": list(self.roles), "direction": self.direction,
            "controls": self.controls, "seed": self.seed,
        }  # fmt: skip

    def conditions(self, bench: Bench) -> Sequence[Condition]:
        """Plain, exchanged, and every place at every role. Raises UnknownSiteError, NoProbesError."""
        found = {place.name: place for pattern in self.sites for place in places(pattern, bench.policy)}
        donors = tuple(dict.fromkeys(site for place in found.values() for site in place.sites))
        wanted = {place: roles_of(bench.policy, place.stream, self.roles) for place in found.values()}
        conditions: list[Condition] = [Plain(), Exchanged()]
        if self.direction == NONE:
            return conditions + [TakenOver(place, role, donors) for place in wanted for role in wanted[place]]
        items = items_of(bench.run, replace(self, items=None))
        found_along = bases_of(bench, items, wanted, self.direction, self.controls, self.seed)
        for (place, role), bases in found_along.items():
            conditions += along(self.direction, bases, place, role, donors)
        return conditions


@dataclass(frozen=True)
class TakenOver:
    """The tokens of one role at one place, from the inference before exchanged pictures.

    donors: all sites of which that inference is asked, once for all conditions. direction: the name of one of
    `bases`, empty to take tokens over whole.
    """

    place: Place
    role: str
    donors: tuple[Site, ...]
    direction: str = ""
    bases: Bases | None = None

    @property
    def name(self) -> str:
        """Place, role and direction, apart by `|`."""
        return "|".join(filter(None, (self.place.name, self.role, self.direction)))

    def play(self, turn: Turn) -> Played:
        """The plain inference with these tokens in it."""
        question, bench = turn.question, turn.bench
        tokens = role_tokens(bench.policy, question, self.place.stream, self.role, turn.memo)
        with patched(bench.policy, self.place.sites, tokens, self._change(turn, tokens.count)) as ledger:
            chunk = bench.act(question.seen, question.seed)
        return Played(chunk, ledger)

    def _change(self, turn: Turn, tokens: int) -> Change:
        donor = donor_of(turn, self.donors)
        if self.bases is None:
            return Replaced(donor, tokens)
        basis = self.bases.basis(self.direction, turn.question.episode_id, turn.question.category)
        return ReplacedAlong(donor, tokens, basis)


def along(direction: str, bases: Bases, place: Place, role: str, donors: tuple[Site, ...]) -> list[TakenOver]:
    """What is taken over along a direction, and along each of its controls."""
    return [TakenOver(place, role, donors, name, bases) for name in (direction, *bases.control_names)]


def donor_of(turn: Turn, sites: Sequence[Site]) -> "ActivationCache":
    """What all these sites hold before exchanged pictures, with the question's state and noise; made once."""
    from probe_kit.hooks import capture

    if "donor" not in turn.memo:
        with capture(turn.bench.policy, sites) as tape:
            turn.memo["chunk"] = turn.bench.act(turn.question.exchanged, turn.question.seed)
        turn.memo["donor"] = tape
    donor: ActivationCache = turn.memo["donor"]
    return donor
