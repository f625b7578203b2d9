"""The verdict: is what can be read also used? Loads no model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.kinds.image_swap.effects import SMALLEST_EFFECT_OF_INTEREST, ImageSwapEffect

if TYPE_CHECKING:
    from probe_kit.train.results.probe_results import ProbeResults

Verdict = Literal[
    "used",
    "encoded, unused",
    "encoded, acted against",
    "absent",
    "acted on, not found",
    "acted against, not found",
    "follows",
    "acts against",
    "does not follow",
    "inconclusive",
]


@dataclass(frozen=True)
class UseVerdict:
    """A verdict, and in a few words what it rests on or why there is none."""

    verdict: Verdict
    reason: str = ""


def classify_use(
    encoded: bool | None,
    found: ImageSwapEffect,
    control: str | None,
    located: Sequence[str] | None = None,
    carried: Sequence[str] = (),
) -> UseVerdict:
    """The verdict of probes and the image swap together.

    encoded: whether the answer can be read in the backbone, beyond chance and every control that was run; None
    without probes. control: another category of the run that follows, which shows that following would have been
    seen; None if there is none, and then nothing is called encoded and unused. located: places that carry half of
    the effect, if an interchange searched for them; where it did and found none, nothing is called used. carried:
    places and the directions along which half of it passes there.
    """
    if found.follows_images:
        if encoded and located is not None:
            if not located:
                return UseVerdict("inconclusive", "it follows, and no place that was tried carries half of that")
            return UseVerdict("used", describe_sites(located, carried))
        return UseVerdict(_by(encoded, "used", "acted on, not found", "follows"))
    if found.is_against:
        return UseVerdict(_by(encoded, "encoded, acted against", "acted against, not found", "acts against"))
    if not found.is_bounded:
        low, high = found.net_follow_rate_ci
        return UseVerdict(
            "inconclusive",
            f"the net follow rate may lie from {low:.2f} to {high:.2f}; {SMALLEST_EFFECT_OF_INTEREST} would count",
        )
    if encoded and control is None:
        return UseVerdict(
            "inconclusive", "no other category of the run follows, so following is not known to show"
        )
    reason = f"positive control: {control}" if encoded and control else ""
    return UseVerdict(_by(encoded, "encoded, unused", "absent", "does not follow"), reason)


def describe_sites(located: Sequence[str], carried: Sequence[str] = ()) -> str:
    """Where the answer passes, of keys and values that the acting stream reads where it is read, and along what.

    A patch in the backbone shows that something downstream depends on that place; one in `kv`, which only the
    acting stream reads, that it is read there.
    """
    read = [place for place in located if place.partition(".")[0] == KV_STREAM]
    passes = [place for place in located if place not in read]
    parts = [f"passes at {', '.join(passes)}"] * bool(passes) + [f"read at {', '.join(read)}"] * bool(read)
    parts += [f"carried by {', '.join(carried)}"] * bool(carried)
    return "; ".join(parts)


def _by(encoded: bool | None, yes: Verdict, no: Verdict, unknown: Verdict) -> Verdict:
    return unknown if encoded is None else yes if encoded else no


def control_for(category: str, found: Mapping[str, ImageSwapEffect]) -> str | None:
    """Another category of the run that follows, the one that does so most; None if there is none."""
    others = [one for one in found.values() if one.category != category and one.follows_images]
    return max(others, key=lambda one: one.net_follow_rate).category if others else None


def classify_all(
    found: Mapping[str, ImageSwapEffect],
    encoded: Mapping[str, bool | None],
    located: Mapping[str, Sequence[str]] = MappingProxyType({}),
    carried: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> dict[str, UseVerdict]:
    """Of every category that was intervened on.

    encoded, located, carried: by category; one that is not there was not probed, or not looked for inside.
    """
    return {
        name: classify_use(
            encoded.get(name), one, control_for(name, found), located.get(name), carried.get(name, ())
        )
        for name, one in found.items()
    }


def encoded_in(results: "ProbeResults | None", view: str | None = None) -> dict[str, bool | None]:
    """By category, whether the backbone's best site beats chance and every control that was run.

    As `retention` has it. view: None for the first that was probed. Empty without probes.
    """
    if results is None:
        return {}
    scores = results.scores
    own = scores[(scores["stream"] == "backbone") & (scores["view"] == (view or results.settings.views[0]))]
    best = own.loc[own.groupby("category", sort=False)["accuracy"].idxmax()]
    return {str(row["category"]): bool(row["signal"]) for _, row in best.iterrows()}
