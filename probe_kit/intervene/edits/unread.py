"""Places that nothing reads: the ends of streams that a family declares unread."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from probe_kit.hooks.contract.interventions import Interventions
from probe_kit.intervene.edits.sites import RESIDUAL, PlaceName, parse_pattern

if TYPE_CHECKING:
    from probe_kit.hooks import Stream

FINAL_NORM = "final_norm"


def unread_places(
    patterns: Iterable[str], streams: "Mapping[str, Stream]", interventions: Interventions
) -> tuple[str, ...]:
    """Places of these patterns at the end of an unread stream: an edit there changes no action.

    streams: of the run or the policy, by name. interventions: declared by the family.
    """
    places = []
    for pattern in patterns:
        parts = parse_pattern(pattern)
        if parts is None or parts["stream"] not in interventions.unread or parts["stream"] not in streams:
            continue
        last, quantity = streams[parts["stream"]].layers - 1, parts["quantity"] or ""
        reaches_end = parts["layer"] == "*" or int(parts["layer"] or 0) == last
        if quantity in ("", RESIDUAL) and reaches_end:
            places.append(str(PlaceName(parts["stream"], last, quantity)))
        elif quantity == FINAL_NORM:
            places.append(pattern)
    return tuple(dict.fromkeys(places))


def unread_note(places: Iterable[str]) -> str:
    """The sentence about unread places."""
    return (
        f"unread: {', '.join(places)}. Nothing that acts reads the end of this stream, so that an edit there "
        "changes no action whatever probes read in it: a control, no place to steer at"
    )
