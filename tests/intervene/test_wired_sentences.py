"""Behaviour, place and tie of every wiring, as a run with probes and stored interventions says them.

The truth beside each is the mechanism in `wirings`.
"""

import pytest

from probe_kit.intervene import JointPlaces, UseVerdict
from tests.intervene.test_wirings import VERDICTS
from tests.intervene.wired_run import concluded
from tests.intervene.wirings import WIRINGS, WiredSession

pytestmark = pytest.mark.slow
IS_READ = "the readable copy is read (backbone.01 language)"
ELSEWHERE = "the readable copy is not the one used: the answer passes elsewhere"
NO_COPY, OPEN = "no readable copy found", "whether the readable copy is the one used remains open"
ONE_BLOCK = "passes at backbone.01; read at kv.01 language"
ALONG = f"{ONE_BLOCK}; carried by mean-difference at backbone.01 language"
BLOCK_1 = (ALONG, IS_READ)
"""Read by the acting part from the words of block 1, which hold one linear copy."""
UNUSED = ("", "")
TRUTHS = {
    **dict.fromkeys(("copied", "backup", "repair", "decoy", "against", "once"), BLOCK_1),
    **dict.fromkeys(("weak", "shifted", "faint", "one-sided", "rarely"), BLOCK_1),
    **dict.fromkeys(("unread", "other", "constant", "noise", "trace", "late"), UNUSED),
    "nonlinear": (ONE_BLOCK, NO_COPY),
    "marks": ("read at kv.00 image", NO_COPY),
    "roles": (
        "passes at backbone.01; no single place: read jointly at kv.01 language + kv.01 state",
        OPEN,  # was *the answer passes elsewhere*, but the words are one of three parts that decide
    ),
    "blocks": (
        "passes at backbone.01; carried by mean-difference at backbone.01 language; no single place: read jointly "
        "at kv.01 language + kv.02 language",
        IS_READ,
    ),
    "bypass": ("past kv", ELSEWHERE),
    "elsewhere": ("read at kv.00 image", ELSEWHERE),
    "code": (
        ONE_BLOCK,
        "the readable copy is not the one used: another code in the same place (backbone.01 language)",
    ),
    "opposite": (
        "passes at backbone.01, backbone.02; read at kv.02 language; carried by mean-difference at backbone.01 "
        "language, backbone.02 language",
        "the readable copy is read (backbone.01 language, backbone.02 language)",
    ),
    "half": (
        "passes at backbone.01; read jointly at kv.00 image + kv.01 language (alone: kv.01 language 0.50)",
        OPEN,  # a second property of the pictures, which block 0 holds, decides whether the answer is read
    ),
    "norms": (ONE_BLOCK, NO_COPY),
    "shared": (
        "passes at backbone.01; carried by mean-difference at backbone.01 language; read jointly at kv.01 "
        "language + kv.01 state (alone: kv.01 language 0.55)",
        IS_READ,
    ),
    "beside": ("all cells of kv carry 0.40 of it", OPEN),
    "opposing": ("opposed at kv.01 language; all cells of kv carry -2.00 of it", OPEN),
    "balance": (f"{ALONG}; opposed at kv.02 language", IS_READ),
    "behind": ("read at kv.00 image", ELSEWHERE),
    "either": UNUSED,
}


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, UseVerdict]:
    return concluded(WiredSession(), list(WIRINGS), tmp_path_factory.mktemp("wired"))


def test_every_wiring_has_a_truth() -> None:
    assert TRUTHS.keys() == WIRINGS.keys()


@pytest.mark.parametrize("name", WIRINGS)
def test_behaviour_place_and_tie_are_true_of_the_wiring(name: str, verdicts: dict[str, UseVerdict]) -> None:
    assert (verdicts[name].verdict, verdicts[name].where, verdicts[name].tie) == (VERDICTS[name], *TRUTHS[name])


def test_a_later_search_of_a_part_does_not_replace_that_of_all_kv(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """The end of the backbone is unread: the verdict said *past backbone*."""
    part = JointPlaces(sites=("backbone.03",), roles=("image", "language", "state"))
    folder = tmp_path_factory.mktemp("part")
    verdicts = concluded(WiredSession(), ["blocks", "constant"], folder, more_interventions=(part,))
    assert (verdicts["blocks"].where, verdicts["blocks"].tie) == TRUTHS["blocks"]


def test_a_direction_that_carries_it_is_no_missing_copy(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Nine permutations show nothing. The sentence had *carried by* beside *no readable copy found*."""
    folder = tmp_path_factory.mktemp("few")
    verdict = concluded(WiredSession(), ["copied", "constant"], folder, permutations=9)["copied"]
    expected = "probes find no copy beyond chance, but a linear direction carries it (backbone.01 language)"
    assert (verdict.where, verdict.tie) == (ALONG, expected)


def test_an_answer_read_at_one_iteration_of_ten_is_found(tmp_path_factory: pytest.TempPathFactory) -> None:
    """At the eighth. What it reads is the same at every iteration, so that the place is where it lies."""
    verdicts = concluded(WiredSession(iterations=10), ["once", "constant"], tmp_path_factory.mktemp("once"))
    assert (verdicts["once"].verdict, verdicts["once"].where, verdicts["once"].tie) == ("used", *BLOCK_1)


def test_a_copy_in_the_pictures_with_the_opposite_sign_is_not_the_one_that_is_used(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Probes of the pictures find a decoy; the words of block 2 are read."""
    folder = tmp_path_factory.mktemp("opposite")
    verdict = concluded(WiredSession(), ["opposite", "constant"], folder, view="mean:image")["opposite"]
    assert (verdict.verdict, verdict.tie) == ("used", ELSEWHERE)
    assert "read at kv.02 language" in verdict.where
