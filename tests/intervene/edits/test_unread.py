"""Places that nothing reads are named, and places of a wildcard without a direction are passed over by name."""

import pytest

from probe_kit.errors import NoDirectionError
from probe_kit.hooks.contract.declared import Interventions
from probe_kit.hooks.contract.sites import Stream
from probe_kit.intervene import Interchange, JointPlaces, Steering
from probe_kit.intervene.places import unread_note, unread_places
from probe_kit.intervene.runner import unread_sites
from probe_kit.intervene.sessions.session import ReplaySession
from probe_kit.runs import Run

STREAMS = {"backbone": Stream("backbone", 4, 8), "expert": Stream("expert", 4, 8, 10)}
UNREAD = Interventions(unread=("backbone",))


@pytest.mark.parametrize(
    ("patterns", "places"),
    [
        (["backbone.*"], ("backbone.03",)),
        (["backbone.03", "backbone.*"], ("backbone.03",)),
        (["backbone.02", "expert.03", "kv.*", "backbone.*.heads.*"], ()),
        (["backbone.03.residual"], ("backbone.03.residual",)),
        (["backbone.03.final_norm"], ("backbone.03.final_norm",)),
    ],
)
def test_the_end_of_an_unread_stream_is_unread_and_nothing_before_it(
    patterns: list[str], places: tuple[str, ...]
) -> None:
    assert unread_places(patterns, STREAMS, UNREAD) == places
    assert unread_places(patterns, STREAMS, Interventions()) == ()
    assert not places or places[0] in unread_note(places)


def test_unread_places_of_every_kind_are_known_before_anything_is_loaded(copy: Run) -> None:
    last = f"backbone.{copy.streams['backbone'].layers - 1:02d}"
    for intervention in (
        Interchange(),
        Steering(sites=(last,), role="language"),
        JointPlaces(sites=(last,), roles=("image", "language")),
    ):
        assert unread_sites(copy, intervention) == (last,)
    assert unread_sites(copy, Steering(sites=("backbone.01",), role="language")) == ()


def test_a_wildcard_passes_over_places_without_a_direction_and_a_named_place_is_refused(
    session: ReplaySession,
) -> None:
    asked = {"role": "language", "categories": ("color",), "controls": 1, "coefficients": (2.0,)}
    session.passed_over.clear()
    found = Steering(sites=("backbone.*",), **asked).conditions(session)  # type: ignore[arg-type]
    assert list(session.passed_over) == ["backbone.00 language"]
    assert "class means of left and right are equal" in session.passed_over["backbone.00 language"]
    names = {condition.name.partition("|")[0] for condition in found[1:]}
    assert "backbone.00" not in names
    assert "backbone.01" in names
    with pytest.raises(NoDirectionError, match=r"backbone\.00"):
        Steering(sites=("backbone.00",), **asked).conditions(session)  # type: ignore[arg-type]
    session.passed_over.clear()
