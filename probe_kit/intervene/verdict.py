"""The verdict: does the action use the answer, and where inside does it pass? Loads no model.

`classify_use` alone makes a verdict; `docs/causal.md` has its rules. Three questions have answers of their own.
The behaviour is that of the image swap. The place is found by interchanges. The tie tells whether the copy that
probes read is the one that is used.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil, inf
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from probe_kit._tables.numbers import whole_percent
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.kinds.image_swap import SMALLEST_SHARE_OF_INTEREST, ImageSwapEffect
from probe_kit.intervene.places import list_places
from probe_kit.intervene.settings import FIRST_CHUNK, PER_STEP
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.sufficiency import SMALLEST_EFFECT_OF_INTEREST, groups_to_decide
from probe_kit.suite.items import Side

if TYPE_CHECKING:
    from probe_kit.train.results.probe_results import ProbeResults


Behaviour = Literal[
    "used",
    "partly used, one-sided",
    "partly used, graded",
    "moves with it, does not decide",
    "not used",
    "undecided",
]
USES: tuple[Behaviour, ...] = ("used", "partly used, one-sided", "partly used, graded")
"""Behaviours in which the answer decides something."""
# Choices, which `docs/causal.md` states as the rule; `docs/notes/causal.md` has how often they are wrong.
DECIDES = 0.50
"""Net follow rate, and share of the reach, from which the answer decides; of the episodes of one side as well."""
FEW = 0.10
"""Net follow rate from which single decisions count."""
TRACE = 0.01
"""Share of the reach below which a displacement is not worth a sentence."""
NO_COPY, NOT_TESTED = "no readable copy found", "whether the readable copy is the one used was not tested"
NOT_LOCATED = "no place that was tried carries half of it"
MANY = 1000
"""Groups of items beyond which a number is no plan: the effect lies at the bound."""
_READOUTS: Mapping[str, str] = MappingProxyType(
    {FIRST_CHUNK: "in the first chunk", PER_STEP: "over the whole episode"}
)
UNTESTED = "whether the answer is used was not tested"
"""Words of a verdict without an image swap."""


@dataclass(frozen=True, kw_only=True)
class UseVerdict:
    """The verdict: is the answer used, where does it pass, and is the copy that probes read the one used?

    Attributes:
        behaviour: Behaviour in the image swap.
        reason: Numbers on which the verdict rests, or why there is none.
        reversed: Whether the behaviour is away from the correct picture.
        side: Side of a behaviour that is one-sided; None for others.
        where: Places at which the answer passes or is read, by interchanges; empty if none was stored.
        tie: Tie between the readable copy and the behaviour; empty without probes.
        readout: Readout of all of these, `first-chunk` or `per-step`.
        lacks_control: Whether nothing is missing for *not used* but another category of the run that is used.
        other: The behaviour by the other readout; None if that is not stored.
    """

    behaviour: Behaviour
    reason: str
    reversed: bool = False
    side: Side | None = None
    where: str = ""
    tie: str = ""
    readout: str = FIRST_CHUNK
    lacks_control: bool = False
    other: "UseVerdict | None" = None

    @property
    def is_used(self) -> bool:
        """Whether it decides something, wholly or in part, toward the correct picture or away from it.

        Either readout counts: an answer that is used in the first chunk is used, and so is one that is used later.
        """
        return any(verdict.behaviour in USES for verdict in self.by_readout)

    @property
    def by_readout(self) -> "tuple[UseVerdict, ...]":
        """The verdict and that of the other readout, if it is stored; the first chunk comes first."""
        verdicts = (self,) if self.other is None else (self, self.other)
        return tuple(sorted(verdicts, key=lambda verdict: verdict.readout != FIRST_CHUNK))

    @property
    def verdict(self) -> str:
        """The behaviour, its direction and its side; of both readouts where they differ."""
        first, *second = self.by_readout
        if not second or first.own_verdict == second[0].own_verdict:
            return first.own_verdict
        return f"first chunk {first.own_verdict}; episode {second[0].own_verdict}"

    @property
    def own_verdict(self) -> str:
        """The behaviour, its direction and its side, of its own readout alone."""
        return f"{'against: ' * self.reversed}{self.behaviour}{f' ({self.side})' if self.side else ''}"

    @property
    def is_of_first_chunk(self) -> bool:
        """Whether nothing is known of later chunks."""
        return self.readout == FIRST_CHUNK and self.other is None

    @property
    def is_bounded(self) -> bool:
        """Whether the intervals of every stored readout exclude a use that would matter."""
        return all(verdict.behaviour == "not used" or verdict.lacks_control for verdict in self.by_readout)

    @property
    def explanation(self) -> str:
        """The reason, place and tie."""
        first, *second = self.by_readout
        reasons = [first.reason, *(f"over the whole episode: {verdict.reason}" for verdict in second)]
        return "; ".join(filter(None, (*reasons, self.where, self.tie)))

    @property
    def sentence(self) -> str:
        """The behaviour by every stored readout, place and tie; with the reason where it is not used."""
        first, *second = self.by_readout
        if second and first.own_verdict == second[0].own_verdict:
            both = " and ".join(_READOUTS[verdict.readout] for verdict in (first, *second))
            clauses = [
                first.clause("the answer", both),
                *(f"episode: {verdict.reason}" for verdict in second if verdict.needs_reason),
            ]
        else:
            clauses = [first.clause("the answer"), *(verdict.clause("it") for verdict in second)]
        text = "; ".join(filter(None, (*clauses, self.where, self.tie)))
        return f"{text[0].upper()}{text[1:]}."

    @property
    def needs_reason(self) -> bool:
        """Whether a reader needs its numbers: those of an answer that is not used by its own readout."""
        return self.behaviour not in USES

    @property
    def finding(self) -> tuple[str, str]:
        """The verdict in a word or two, and the action's behaviour, without numbers."""
        first, *later = self.by_readout
        if later and (first.behaviour in USES) != (later[0].behaviour in USES):
            if first.behaviour in USES:
                return "used at first", "the first actions follow the answer, the whole episode does not"
            return "used later", "the first actions do not follow the answer, the whole episode does"
        if self.behaviour == "used":
            in_reverse = ("used in reverse", "the action goes to the other picture")
            return in_reverse if self.reversed else ("used", "the action follows the answer")
        if self.behaviour in USES:
            direction = "goes against" if self.reversed else "follows"
            how = (
                f"only where the correct picture lies on the {self.side}"
                if self.side
                else "in some episodes or part of the way"
            )
            return "partly used", f"the action {direction} the answer {how}"
        if self.behaviour == "moves with it, does not decide":
            return "not decisive", "the answer shifts the action, but not to the other picture"
        if self.behaviour == "not used":
            return "not used", "the action does not follow the answer"
        if self.lacks_control:
            return "use undecided", "the action follows neither this answer nor that of another category"
        return "use undecided", "the items do not tell"

    def describe(self, swap: Any) -> str:
        """Return the result of an image swap, in sentences."""
        return f"{describe_swap(swap, self)}. {self.sentence}"

    def clause(self, answer: str, readout: str = "") -> str:
        """Return the behaviour by its own readout, with the reason where the answer is not used.

        Args:
            answer: Noun for the answer.
            readout: The readout in words; empty for its own.
        """
        when = readout or _READOUTS[self.readout]
        against = ", against the correct picture" * self.reversed
        side = f" ({self.side})" if self.side else ""
        words = {
            "undecided": f"whether {answer} is used {when} is undecided",
            "moves with it, does not decide": f"{answer} moves the action {when}{against}, does not decide",
        }.get(self.behaviour, f"{answer} is {self.behaviour}{side} {when}{against}")
        return f"{words}: {self.reason}" if self.needs_reason else words


def describe_readouts(uses: Iterable[UseVerdict | None]) -> str:
    """Return the readouts of the verdicts in words, for a legend; empty without a verdict."""
    stored = {verdict.readout for use in uses if use is not None for verdict in use.by_readout}
    if not stored:
        return ""
    if len(stored) == 2:
        return "the sentence says which verdict is of the first chunk of actions and which of the whole episode"
    if PER_STEP in stored:
        return "verdicts are of the whole episode"
    return "verdicts are of the first chunk of actions; --readout per-step gives those of the whole episode"


# -- behaviour -------------------------------------------------------------------------------------------------


class _Numbers(NamedTuple):
    """The numbers of an effect toward the correct picture, or of its mirror.

    Attributes:
        p: The p-value of the direction.
        follow: Net follow rate.
        follow_ends: Ends of its interval.
        share: Displacement as a share of the reach.
        share_ends: Ends of its interval.
        reached: By side of the correct picture, how much more often that side is reached.
    """

    p: float
    follow: float
    follow_ends: tuple[float, float]
    share: float
    share_ends: tuple[float, float]
    reached: Mapping[Side, float]

    @classmethod
    def of(cls, effect: ImageSwapEffect, mirrored: bool) -> "_Numbers":
        sign = -1 if mirrored else 1
        reached: dict[Side, float] = {"left": sign * effect.left_reached, "right": sign * effect.right_reached}
        (low, high), (least, most) = (
            limits if not mirrored else (-limits[1], -limits[0])
            for limits in (effect.net_follow_rate_ci, effect.reach_share_ci)
        )
        p, follow = effect.reversal_p if mirrored else effect.follow_p, sign * effect.net_follow_rate
        return cls(p, follow, (low, high), sign * effect.reach_share, (least, most), reached)

    @property
    def only_side(self) -> Side | None:
        """The side that is reached where the answer lies there, if the other one is not; else None."""
        at_left, at_right = self.reached["left"], self.reached["right"]
        if max(at_left, at_right) < DECIDES or min(at_left, at_right) >= SMALLEST_EFFECT_OF_INTEREST:
            return None
        return "left" if at_left > at_right else "right"

    def behaviour(self) -> Behaviour | None:
        """Return the behaviour that the numbers show; None if they show none."""
        is_moved = self.share_ends[0] > SMALLEST_SHARE_OF_INTEREST
        decides = self.follow_ends[0] > 0
        is_beyond_half = decides or self.share_ends[0] > DECIDES
        if self.p >= SIGNIFICANCE:
            return None
        # The first that holds: a policy that decides also moves.
        if is_beyond_half and self.follow >= DECIDES and self.share >= DECIDES:
            return "used"
        if is_moved and self.only_side is not None:
            return "partly used, one-sided"
        if decides and self.follow >= FEW and self.share_ends[0] > 0:
            return "partly used, graded"
        if not is_moved:
            return None
        is_bounded = self.follow_ends[1] < SMALLEST_EFFECT_OF_INTEREST
        return "moves with it, does not decide" if is_bounded else "partly used, graded"


def classify_behaviour(effect: ImageSwapEffect, control: str | None) -> UseVerdict:
    """Return the verdict of the image swap alone.

    Args:
        effect: Effect of the image swap in one category.
        control: Another category of the run that is used, which shows that use would have been visible. None if
            there is none, and then nothing is *not used*.
    """
    for mirrored in (False, True):  # toward the correct picture, then the same rules against it
        numbers = _Numbers.of(effect, mirrored)
        behaviour = numbers.behaviour()
        if behaviour is not None:
            side = numbers.only_side if behaviour == "partly used, one-sided" else None
            return UseVerdict(
                behaviour=behaviour,
                reason=_describe_response(effect),
                reversed=mirrored,
                side=side,
                readout=effect.readout,
            )
    if not is_bounded(effect):
        return UseVerdict(behaviour="undecided", reason=_open(effect), readout=effect.readout)
    bound = (
        f"within {SMALLEST_SHARE_OF_INTEREST} of its reach and {SMALLEST_EFFECT_OF_INTEREST} of the episodes "
        f"({_describe_response(effect)})"
    )
    if control is None:
        reason = f"{bound}, and no other category of the run is used, so that use is not known to show"
        return UseVerdict(behaviour="undecided", reason=reason, readout=effect.readout, lacks_control=True)
    is_trace = min(effect.follow_p, effect.reversal_p) < SIGNIFICANCE and abs(effect.reach_share) > TRACE
    trace = f"but for a trace of {100 * effect.reach_share * effect.reach:.1f} cm: " * is_trace
    reason = f"{trace}{bound}; positive control: {control}"
    return UseVerdict(behaviour="not used", reason=reason, readout=effect.readout)


def is_bounded(effect: ImageSwapEffect) -> bool:
    """Whether both intervals exclude, on both sides, effects that would matter."""
    (low, high), (least, most) = effect.net_follow_rate_ci, effect.reach_share_ci
    flips, share = SMALLEST_EFFECT_OF_INTEREST, SMALLEST_SHARE_OF_INTEREST
    return -flips < low and high < flips and -share < least and most < share


def _describe_response(effect: ImageSwapEffect) -> str:
    """Return displacement and net follow rate with their intervals, in words."""
    return (
        f"moved by {effect.reach_share:z.2f} {_ends(effect.reach_share_ci)} of its reach, net follow rate "
        f"{effect.net_follow_rate:z.2f} {_ends(effect.net_follow_rate_ci)}"
    )


def _open(effect: ImageSwapEffect) -> str:
    """Return the reason why it is undecided."""
    is_graded = min(effect.follow_p, effect.reversal_p) < SIGNIFICANCE
    is_other = effect.moved_share >= SMALLEST_EFFECT_OF_INTEREST and not is_graded
    if is_other and abs(effect.reach_share) < effect.moved_share / 2:
        return (
            f"the images move it by {effect.moved_share:z.2f} of its reach, the answer by "
            f"{effect.reach_share:z.2f} {_ends(effect.reach_share_ci)}: it depends on something else in the "
            "images, or on the answer in opposite directions, or the items are too few"
        )
    return f"{_describe_response(effect)}; {more_groups(effect, effect.n_groups)}, there are {effect.n_groups}"


def more_groups(swap: Any, groups: int) -> str:
    """Return about how many groups of items would decide an effect that is undecided with so many."""
    needed = _groups_to_decide(swap, groups)
    number = f"about {ceil(needed)}" if needed <= MANY else f"more than {MANY}"
    return f"{number} {_WOULD_TELL}"


def items_to_decide(swap: Any, items: int, groups: int) -> str:
    """Return about how many items would decide an effect that is undecided with so many in so many groups."""
    needed, size = _groups_to_decide(swap, groups), items / groups if groups else 1
    number = f"about {ceil(ceil(needed) * size)}" if needed <= MANY else f"more than {ceil(MANY * size)}"
    return f"{number} items would show whether the action follows it"


def _groups_to_decide(swap: Any, groups: int) -> float:
    effects = (
        (swap.net_follow_rate or 0.0, _width(swap.net_follow_rate_ci), SMALLEST_EFFECT_OF_INTEREST),
        (swap.reach_share or 0.0, _width(swap.reach_share_ci), SMALLEST_SHARE_OF_INTEREST),
    )
    return groups_to_decide(groups, effects)


_WOULD_TELL = "groups would tell"


def size_of_groups(texts: Iterable[str], counts: Iterable[tuple[int, int]]) -> str:
    """Return how many groups the items are where a text says how many groups would tell; else an empty text.

    Tables count items, which are what a user adds.

    Args:
        texts: Texts of the verdicts.
        counts: Number of items and groups of each category.
    """
    counted = {(items, groups) for items, groups in counts if groups}
    sizes = sorted({round(items / groups, 1) for items, groups in counted})
    if not sizes or not any(_WOULD_TELL in text for text in texts):
        return ""
    items, groups = max(counted)
    span = f"{sizes[0]:g}" if len(sizes) == 1 else f"{sizes[0]:g} to {sizes[-1]:g}"
    return f"{items} items are {groups} independent groups, because {span} items share each picture"


def _width(limits: tuple[float | None, float | None] | None) -> float:
    low, high = limits or (None, None)
    return inf if low is None or high is None else high - low


def _ends(limits: tuple[float, float]) -> str:
    return "[no interval]" if inf in limits else f"[{limits[0]:z.2f}, {limits[1]:z.2f}]"


# -- with what else is stored ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Places:
    """The findings inside the network, in one category.

    Attributes:
        located: Places that carry half of the effect, see `localised_sites`; None if an interchange did not search
            for them.
        carried: Directions along which half of it passes, each with its place.
        jointly: Finding of joint places, in words. They distinguish tokens where an interchange has those of a
            block together, and they have sets of places.
        remainders: Parts of the effect that these places leave out, in words.
    """

    located: tuple[str, ...] | None = None
    carried: tuple[tuple[str, str], ...] = ()
    jointly: str = ""
    remainders: tuple[str, ...] = ()

    @property
    def parts(self) -> list[str]:
        """The findings in words: where the answer passes, is read and is carried, and what is left."""
        read = [site for site in self.located or () if site.partition(".")[0] == KV_STREAM]
        names_tokens = any(" " in site for site in read)
        is_finer = "read jointly" in self.jointly or (not names_tokens and "read" in self.jointly)
        located = [site for site in self.located or () if not (is_finer and site in read)]
        jointly = self.jointly if is_finer or not read else ""
        return [*describe_sites(located, self.carried), *([jointly] if jointly else []), *self.remainders]

    def __str__(self) -> str:
        return "; ".join(self.parts) or (NOT_LOCATED if self.located is not None else "")


def classify_use(
    encoded: bool | None,
    effect: ImageSwapEffect,
    control: str | None,
    places: Places | None = None,
    tie: str = "",
    other: UseVerdict | None = None,
) -> UseVerdict:
    """Return the verdict of the image swap, with the findings of probes and interventions inside the network.

    Args:
        encoded: Whether the answer can be read in the backbone, beyond chance and every control that was run; None
            without probes.
        effect: Effect of the image swap in one category.
        control: Another category of the run that is used, see `classify_behaviour`; None if there is none.
        places: Findings inside the network; None if nothing was tried there.
        tie: Tie in words, see `evidence.describe_tie`; empty if it was not tested.
        other: The behaviour by the other readout, see `evidence.StoredEvidence.other_readouts`; None if that is
            not stored.
    """
    use = replace(classify_behaviour(effect, control), other=other)
    if all(verdict.behaviour in ("not used", "undecided") for verdict in use.by_readout):
        return use
    tie_text = "" if encoded is None else tie or (NOT_TESTED if encoded else NO_COPY)
    return replace(use, where=str(places or ""), tie=tie_text)


def describe_sites(located: Sequence[str], carried: Sequence[tuple[str, str]] = ()) -> list[str]:
    """Return where the answer passes, where the acting stream reads it, and along which directions, in words.

    A patch in the backbone shows that something downstream depends on that place. One in `kv`, which only the
    acting stream reads, shows that it is read there.
    """
    read = [site for site in located if site.partition(".")[0] == KV_STREAM]
    passes = [site for site in located if site not in read]
    along: dict[str, list[str]] = {}
    for direction, site in carried:
        along.setdefault(direction, []).append(site)
    parts = [f"{verb} at {list_places(sites)}" for verb, sites in (("passes", passes), ("read", read)) if sites]
    for number, (direction, places) in enumerate(along.items()):
        parts.append(f"{'' if number else 'carried by '}{direction} at {list_places(places)}")
    return parts


def control_for(category: str, effects: Mapping[str, ImageSwapEffect]) -> str | None:
    """Return another category of the run that is used, the one with most episodes that follow; None if none is."""
    used = [
        effect
        for effect in effects.values()
        if effect.category != category and classify_behaviour(effect, None).is_used
    ]
    return max(used, key=lambda effect: abs(effect.net_follow_rate)).category if used else None


def classify_all(
    effects: Mapping[str, ImageSwapEffect],
    encoded: Mapping[str, bool | None],
    places: Mapping[str, Places] = MappingProxyType({}),
    ties: Mapping[str, str] = MappingProxyType({}),
    other_readouts: Mapping[str, UseVerdict] = MappingProxyType({}),
) -> dict[str, UseVerdict]:
    """Return the verdict of every category that was intervened on.

    A category that is missing in a mapping was not probed, not searched inside, or measured by one readout alone.

    Args:
        effects: Effects of the image swap, by category.
        encoded: Whether the answer can be read in the backbone, by category; None without probes.
        places: Findings inside the network, by category.
        ties: Tie in words, by category.
        other_readouts: The behaviour by the other readout, by category.
    """
    return {
        name: classify_use(
            encoded.get(name),
            effect,
            control_for(name, effects),
            places.get(name),
            ties.get(name, ""),
            other_readouts.get(name),
        )
        for name, effect in effects.items()
    }


def encoded_in(results: "ProbeResults | None", view: str | None = None) -> dict[str, bool | None]:
    """Return by category whether the backbone's best site beats chance and every control that was run.

    The rule is that of `retention`. Empty without probes.

    Args:
        results: Probes of the run; None without any.
        view: View of the probes; None for the first that was probed.
    """
    if results is None:
        return {}
    scores = results.scores
    backbone_scores = scores[
        (scores["stream"] == "backbone") & (scores["view"] == (view or results.settings.views[0]))
    ]
    best = backbone_scores.loc[backbone_scores.groupby("category", sort=False)["accuracy"].idxmax()]
    return {str(row["category"]): bool(row["signal"]) for _, row in best.iterrows()}


def describe_swap(swap: Any, use: UseVerdict) -> str:
    """Return the effect of a swap of the pictures on the action, with numbers that the verdict's sentence lacks.

    Numbers and words are of the verdict's own readout.
    """
    use = replace(use, other=None)
    low, high = (whole_percent(limit) for limit in swap.net_follow_rate_ci or (None, None))
    followed, net = f"in {whole_percent(swap.follow_rate)} % of episodes", f"net of reversals {low} to {high} %"
    moved = "" if swap.reach_share is None else f", moved by {swap.reach_share:z.2f} of its reach"
    if use.behaviour == "used" and not use.reversed:
        return f"the action follows a swap of the pictures {followed} ({net})"
    if use.behaviour == "used":
        against = f"in {whole_percent(swap.reversal_rate)} % of episodes"
        return f"the action goes against the pictures, swapped or not, {against}"
    if use.is_bounded:
        return f"the action does not follow a swap of the pictures ({followed})"
    if use.behaviour == "undecided":
        return f"whether the action follows a swap of the pictures is undecided ({followed})"
    numbers = f"{followed}, {net}{moved}" if use.is_used else followed
    return f"the action follows a swap of the pictures in part ({numbers})"
