"""One of every kind is stored, in many orders: whatever came last, nothing takes another's place."""

import random
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from probe_kit.hooks import Site
from probe_kit.intervene import (
    AttentionShares,
    ConditionOutcomes,
    best_patch_targets,
    classify_all,
    stored_attention,
    stored_image_swaps,
)
from probe_kit.intervene.evidence import StoredEvidence
from probe_kit.intervene.inventory import listed_interventions
from probe_kit.intervene.kinds.attention import ATTENTION_FILE
from probe_kit.intervene.kinds.interchange import (
    localised_by_category,
    stored_site_effects,
    stored_steering,
    stored_subspace_effects,
)
from probe_kit.intervene.outcomes import arrays_to_bytes
from probe_kit.intervene.results import InterventionResult, verdicts_of
from probe_kit.intervene.settings import FORMAT, key_of
from probe_kit.intervene.stored import find_stored
from probe_kit.runs.layout import INTERVENTIONS
from probe_kit.runs.results import write_bundle
from probe_kit.train import ArrayRun
from tests.intervene.answers import follower, habit, outcomes_of, store_outcomes

MANY, FEW = 24, 4
Moves = Mapping[str, float]
"""By condition, the share of episodes that go where the exchange brings them."""


def color(episodes: int = MANY) -> ConditionOutcomes:
    return outcomes_of({"color": follower(episodes)})


def unmoved(outcomes: ConditionOutcomes) -> ConditionOutcomes:
    """Where the pictures change nothing."""
    return replace(outcomes, displacement=np.stack([outcomes.of("clean")] * 2))


def asked_otherwise(outcomes: ConditionOutcomes) -> ConditionOutcomes:
    """With the conditions of an instruction swap, none of which changes anything."""
    names = ("clean", "instruction_swap", "image_swap", "noise")
    clean = np.stack([outcomes.of("clean")] * 4)
    logs = np.zeros((*clean.shape, 5))
    return replace(outcomes, conditions=names, displacement=clean, max_action_change=0 * clean, edit_log=logs)


def moved(outcomes: ConditionOutcomes, moves: Moves) -> ConditionOutcomes:
    turned = np.arange(outcomes.episodes.size)
    rows = [
        np.where(turned < share * turned.size, outcomes.of("image_swap"), outcomes.of("clean"))
        for share in moves.values()
    ]
    displacement = np.vstack([outcomes.displacement, *rows])
    return replace(
        outcomes,
        conditions=(*outcomes.conditions, *moves),
        displacement=displacement,
        max_action_change=np.abs(displacement - displacement[0]),
        edit_log=np.ones((*displacement.shape, 5)),
    )


def attention_records(episodes: int, *roles: str) -> tuple[ConditionOutcomes, dict[str, bytes]]:
    outcomes = color(episodes)
    mass = np.full((episodes, 2, 1, 1, len(roles)), 1 / episodes, np.float32)
    weighed = AttentionShares(
        roles,
        outcomes.episodes,
        outcomes.groups,
        outcomes.categories,
        outcomes.sides,
        np.zeros(episodes, int),
        mass,
    )
    return outcomes, {ATTENTION_FILE: arrays_to_bytes(weighed)}


def ended(outcomes: ConditionOutcomes) -> ConditionOutcomes:
    """Outcomes of a closed loop without any flip."""
    changed = moved(outcomes, {"backbone.02|image": 0.0})
    return replace(changed, episode_outcomes=np.full(changed.displacement.shape, "correct"))


CONTROL = "backbone.02|image|control-1"
WRONG = {"target_side": "wrong", "direction": "mean-difference", "seed": 0}
STEERED = {"backbone.01|image|mean-difference|0": 0.0, "backbone.01|image|mean-difference|2": 0.5}
MAP = {"backbone.00|all": 1.0, "backbone.00|image": 1.0, "backbone.02|all": 1.0, "backbone.02|image": 1.0,
       "backbone.10|all": 0.0}  # fmt: skip
POOL: dict[str, tuple[str, dict[str, Any], Callable[[], ConditionOutcomes]]] = {
    "image-swap": ("image-swap", {}, lambda: outcomes_of({"color": follower(MANY), "shape": habit(MANY)})),
    "follow, few": ("image-swap", {"items": 2}, lambda: color(FEW)),
    "follow, shadow": ("image-swap", {"readout": "per-step"}, lambda: unmoved(color())),
    "instruction-swap": ("instruction-swap", {}, lambda: asked_otherwise(color())),
    "map": ("interchange", {"direction": "none"}, lambda: moved(color(), MAP)),
    "map, few": ("interchange", {"direction": "none", "items": 2},
                 lambda: moved(color(FEW), dict.fromkeys(MAP, 0.0))),
    "map, shadow": ("interchange", {"direction": "none", "readout": "per-step"},
                    lambda: moved(unmoved(color()), {"backbone.00|all": 0.0})),
    "end": ("interchange", {"direction": "none", "sites": "backbone.10"},
            lambda: moved(color(), {"backbone.10|all": 0.0, "backbone.10|image": 0.0})),
    "tiles": ("interchange", {"direction": "none", "roles": ["image.left"]},
              lambda: moved(color(), {"backbone.02|image.left": 0.0})),
    "kv": ("interchange", {"direction": "none", "sites": "kv.*"},
               lambda: moved(color(), {"kv.00|all": 0.0, "kv.02|all": 1.0})),
    "expert": ("interchange", {"direction": "none", "sites": "expert.03@0"},
               lambda: moved(color(), {"expert.03@0|all": 0.0})),
    "along": ("interchange", {"direction": "mean-difference", "seed": 0},
              lambda: moved(color(), {"backbone.02|image|mean-difference": 1.0, CONTROL: 0.0})),
    "along a probe": ("interchange", {"direction": "probe", "seed": 0},
                      lambda: moved(color(), {"backbone.02|image|probe": 0.0, CONTROL: 0.0})),
    "steer": ("steer", WRONG, lambda: moved(color(), STEERED)),
    "steer, dose": ("steer", WRONG | {"coefficients": [4]},
                    lambda: moved(color(), {"backbone.01|image|mean-difference|4": 1.0})),
    "steer, place": ("steer", WRONG | {"sites": "backbone.02"},
                     lambda: moved(color(), {"backbone.02|image|mean-difference|2": 0.0})),
    "steer, left": ("steer", {"target_side": "left", "direction": "mean-difference", "seed": 0},
                    lambda: moved(color(), {"backbone.01|image|mean-difference|2": 0.0})),
    "steer, few": ("steer", WRONG | {"items": 2},
                   lambda: moved(color(FEW), dict.fromkeys(STEERED, 0.0))),
    "erase": ("erase", {}, lambda: moved(color(), {"backbone.02|image|leace|1": 1.0})),
    "closed loop": ("closed-loop", {}, lambda: ended(color())),
    "attention": ("attention", {"roles": []}, lambda: color()),
    "attention, few": ("attention", {"roles": [], "items": 2}, lambda: color(FEW)),
    "attention, a role": ("attention", {"roles": ["image"]}, lambda: color()),
}  # fmt: skip
SHARES = {"attention": (MANY, "all", "image"), "attention, few": (FEW, "all", "image"),
          "attention, a role": (MANY, "all")}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> ArrayRun:
    outcomes = outcomes_of({"color": follower(MANY), "shape": habit(MANY)})
    episodes = pd.DataFrame(
        {
            "episode_id": outcomes.episodes, "item_id": outcomes.items, "group_id": outcomes.groups,
            "category": outcomes.categories, "side_correct": outcomes.sides, "layout": "original",
            "outcome": "correct", "side_placed": outcomes.sides,
        }
    )  # fmt: skip
    blank = np.zeros((len(episodes), 1))
    path = tmp_path_factory.mktemp("standing")
    array_run = ArrayRun(path, "pi0", "suite@1#0123456789ab", episodes, {(Site("backbone", 0), "mean"): blank})
    for name in POOL:
        store(array_run, name)
    return array_run


def settings_of(run: ArrayRun, name: str) -> dict[str, Any]:
    kind, options, make = POOL[name]
    categories = list(dict.fromkeys(make().categories.tolist()))
    return {
        "format": FORMAT, "kind": kind, "run_settings": run.settings_sha256, "stamp": "", "wording": None,
        "categories": categories, "readout": "first-chunk", **options,
    }  # fmt: skip


def store(run: ArrayRun, name: str) -> None:
    _, _, make = POOL[name]
    outcomes, extra_files = attention_records(*SHARES[name]) if name in SHARES else (make(), {})
    store_outcomes(run.location, run.suite, settings_of(run, name), outcomes, extra_files=extra_files)


def made_in(run: ArrayRun, names: list[str]) -> None:
    """As if they had been stored in this order."""
    for at, name in enumerate(names):
        settings = settings_of(run, name)
        times = {"created": f"2026-01-01T00:00:{at:02d}"}
        write_bundle(run.location, INTERVENTIONS, key_of(settings), {"settings": settings}, times=times)


def read(run: ArrayRun) -> dict[str, Any]:
    """Every quantity that verdicts, tables and figures take from what is stored."""
    swaps, encoded = stored_image_swaps(run), {"color": True, "shape": True}
    return {
        "follows": swaps,
        "maps": stored_site_effects(run),
        "along": stored_subspace_effects(run),
        "steering": stored_steering(run),
        "attention": {name: arrays_to_bytes(arrays) for name, arrays in stored_attention(run).items()},
        "verdicts": classify_all(swaps, encoded, StoredEvidence(run).places),
        "targets": best_patch_targets(run, ["color"]),
    }


ORDERS = [list(POOL), list(POOL)[::-1], random.Random(0).sample(list(POOL), len(POOL))]
"""Of any two, each comes last in one of them."""


@pytest.mark.slow
def test_the_selected_results_do_not_depend_on_the_order_in_which_they_were_stored(run: ArrayRun) -> None:
    made_in(run, ORDERS[0])
    first = read(run)
    for order in ORDERS[1:]:
        made_in(run, order)
        again = read(run)
        for name, value in first.items():
            # Where two have the same condition on the same episodes, only of which of them it is read differs.
            assert unkeyed(again[name]) == unkeyed(value), (name, order[-3:])


def unkeyed(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: unkeyed(item) for name, item in value.items()}
    if isinstance(value, list):
        return [replace(row, key="") for row in value]
    return value


@pytest.mark.slow
def test_every_quantity_is_of_what_it_is_about(run: ArrayRun) -> None:
    quantities = read(run)
    verdict = quantities["verdicts"]["color"]
    assert verdict.behaviour == "used"
    assert verdict.where == (
        "passes at backbone.02; read at kv.02; carried by mean-difference at backbone.02 image"
    )
    assert quantities["verdicts"]["shape"].behaviour == "not used"
    assert (quantities["follows"]["color"].follow_rate, quantities["follows"]["color"].n_episodes) == (1.0, MANY)
    cells = [(row.sites, row.role, row.net) for row in quantities["maps"]["color"]]
    assert cells == [
        ("backbone.00", "all", 1.0), ("backbone.00", "image", 1.0), ("backbone.02", "all", 1.0),
        ("backbone.02", "image", 1.0), ("backbone.02", "image.left", 0.0), ("backbone.10", "all", 0.0),
        ("backbone.10", "image", 0.0), ("expert.03@0", "all", 0.0), ("kv.00", "all", 0.0),
        ("kv.02", "all", 1.0),
    ]  # fmt: skip
    assert {row.n_episodes for row in quantities["maps"]["color"]} == {MANY}
    assert [row.direction for row in quantities["along"]["color"]] == [
        "control-1", "mean-difference", "control-1", "probe",
    ]  # fmt: skip
    coefficients = {
        name: [row.coefficient for row in rows] for name, rows in quantities["steering"]["color"].items()
    }
    assert coefficients == {
        "backbone.01 image, toward left": ["2"], "backbone.01 image": ["0", "2", "4"], "backbone.02 image": ["2"],
    }  # fmt: skip
    assert stored_attention(run)["color"].roles == ("all", "image")
    assert quantities["targets"] == ("backbone.02|image",)


@pytest.mark.slow
def test_those_of_which_nothing_is_read_are_listed_so(run: ArrayRun) -> None:
    made_in(run, [*(name for name in POOL if name != "map"), "map"])
    names = {key_of(settings_of(run, name)): name for name in POOL}
    states = {names[intervention.key]: intervention.state for intervention in listed_interventions(run)}
    unread = {"follow, few", "map, few", "map, shadow", "steer, few", "attention, few"}
    assert {name for name, state in states.items() if state == "other"} == {*unread, "attention, a role"}


@pytest.mark.slow
def test_the_verdict_says_first_chunk_and_whole_episode_whichever_is_asked_for(run: ArrayRun) -> None:
    """Color follows in the first chunk; the stored episodes along which each step was evaluated do not move."""
    for name, readout in (("image-swap", "first-chunk"), ("follow, shadow", "per-step")):
        key = key_of(settings_of(run, name))
        result = InterventionResult.of_stored(find_stored(run, key))
        verdict = result.verdicts["color"]
        assert (verdict.readout, result.effects[0].readout) == (readout, readout)
        assert verdict.verdict == "first chunk used; episode undecided"
        assert verdict.sentence.startswith(
            "The answer is used in the first chunk; whether it is used over the whole episode is undecided: "
        )
        assert f'"verdict": "{verdict.verdict}"' in result.to_json()
    assert verdicts_of(run)["shape"].sentence.startswith("The answer is not used in the first chunk: ")


def test_a_follow_that_is_asked_for_by_its_key_has_its_own_verdict(run: ArrayRun) -> None:
    key = key_of(settings_of(run, "follow, few"))
    effects = InterventionResult.of_stored(find_stored(run, key))
    assert effects.effects[0].n_episodes == FEW
    assert effects.verdicts["color"].behaviour == "undecided"


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["tiles"], None),
        (["expert"], None),
        (["along a probe"], None),
        (["along"], None),
        (["end"], ()),
        (["end", "kv"], ("kv.02",)),
        (["kv", "tiles", "expert"], ("kv.02",)),
        (["map", "kv"], ("backbone.02", "kv.02")),
    ],
)
def test_a_category_is_searched_where_all_tokens_of_the_backbone_were_exchanged(
    tmp_path: Path, run: ArrayRun, names: list[str], expected: tuple[str, ...] | None
) -> None:
    """A null result for one role, iteration, block or direction does not rule out the others."""
    alone = replace(run, path=tmp_path)
    for name in names:
        store(alone, name)
    assert localised_by_category(stored_site_effects(alone)).get("color") == expected
