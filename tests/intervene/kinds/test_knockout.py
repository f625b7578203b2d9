"""Attention knockout: windows, controls, losses of policies whose reading is known, and sentences."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks import AttentionCut, cut_attention
from probe_kit.intervene import ConditionOutcomes, InterventionResult, Knockout, run_intervention
from probe_kit.intervene.edited_cells import columns_of
from probe_kit.intervene.kinds.knockout import (
    KnockoutEffect,
    by_role,
    knockout_effects,
    layers_read,
    random_tokens,
    reading_of,
    stored_twin,
    windows,
)
from probe_kit.intervene.replay import ConditionContext
from probe_kit.intervene.sessions import ReplaySession
from probe_kit.intervene.stored import stored_interventions
from probe_kit.intervene.tokens import PairTokens
from probe_kit.runs import Run, open_run
from probe_kit.suite import Suite
from tests.intervene.answers import KNOCKOUT_EPISODES, KNOCKOUT_LAYERS, knockout_of
from tests.support.organisms import READERS, is_true_of, reader_run

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

Losses = NDArray[np.float64]


def test_windows_grow_from_either_end_and_hold_each_span_once() -> None:
    assert windows("first", 3) == [(0, 0), (0, 1), (0, 2)]
    assert windows("last", 3) == [(0, 2), (1, 2), (2, 2)]
    assert windows("both", 3) == [(0, 0), (0, 1), (0, 2), (1, 2), (2, 2)]
    assert windows("2", 3) == [(0, 1), (1, 2)]
    with pytest.raises(UsageError, match="more than the 3 layers"):
        windows("4", 3)


def test_controls_are_as_many_tokens_of_other_roles() -> None:
    keys, every = np.arange(20) < 6, np.arange(20) < 18
    drawn = random_tokens(keys, every, 3)
    assert drawn.sum() == 6
    assert not (drawn & (keys | ~every)).any()
    assert (random_tokens(keys, every, 3) == drawn).all()
    assert random_tokens(~keys, every, 3).sum() == 6  # there are no more


def read_by(outcomes: ConditionOutcomes) -> dict[str, list[KnockoutEffect]]:
    return by_role(knockout_effects(outcomes))


@pytest.mark.parametrize("seed", range(5))
def test_reading_in_one_layer_is_found_there_and_words_that_are_unread_are_not(seed: int) -> None:
    roles = read_by(knockout_of({"image": [{2}], "language": []}, seed))
    assert layers_read(roles["image"]) == (2, 2)
    assert layers_read(roles["language"]) is None
    assert re.fullmatch(
        r"the action reads image in layer 2 \(loss of 0\.[89]\d \[.*\] of the picture's effect\); "
        "behind layer 2 nothing is lost",
        reading_of(roles["image"]),
    )
    assert "effect does not come directly from language" in reading_of(roles["language"])


@pytest.mark.parametrize(("layer", "outer"), [(0, (0, 1)), (2, (1, 3)), (5, (4, 5))])
def test_windows_that_slide_give_the_outer_limits_of_all_that_lose(layer: int, outer: tuple[int, int]) -> None:
    assert layers_read(read_by(knockout_of({"image": [{layer}]}, 0, "2"))["image"]) == outer


@pytest.mark.parametrize("seed", range(5))
def test_layers_that_are_each_enough_are_named_together(seed: int) -> None:
    """Reading in layer 1 or in layer 4 is enough: only a cut of both loses."""
    roles = read_by(knockout_of({"image": [{1}, {4}]}, seed))
    assert layers_read(roles["image"]) == (4, 1)
    assert "in layers 1 to 4, where a part is enough" in reading_of(roles["image"])


@pytest.mark.slow
def test_what_nothing_reads_is_read_in_one_of_twenty_cases_at_most() -> None:
    alarms = [
        any(
            layers_read(part) is not None
            for part in read_by(knockout_of({"image": [], "state": []}, seed)).values()
        )
        for seed in range(60)
    ]
    assert np.mean(alarms) <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / 60)


def test_the_loss_is_twice_the_share_of_the_swap() -> None:
    """An action that no longer tells both orders apart lies half way between clean and swapped."""
    roles = read_by(knockout_of({"image": [{0}]}, 0))
    widest = next(row for row in roles["image"] if (row.first, row.last) == (0, KNOCKOUT_LAYERS - 1))
    assert widest.lost == pytest.approx(0.9, abs=0.05)
    assert widest.lost_ci is not None
    assert widest.lost_ci[0] < 0.9 < widest.lost_ci[1]


def unmoved_by_pictures(outcomes: ConditionOutcomes, changes: dict[str, float]) -> ConditionOutcomes:
    """The same, with pictures that move no action and cuts of roles that change it by so many spreads."""
    size = np.array([[changes.get(cell.role, 0.0) * (cell.direction == "cut")] for cell in outcomes.cells])
    moved = np.broadcast_to(outcomes.displacement[0], outcomes.displacement.shape).copy()
    return replace(outcomes, displacement=moved, size=np.repeat(size, moved.shape[1], axis=1))


def test_where_the_picture_moves_nothing_any_change_counts() -> None:
    roles = read_by(unmoved_by_pictures(knockout_of({"image": [], "language": []}, 0), {"language": 2.0}))
    assert layers_read(roles["image"]) is None
    assert layers_read(roles["language"]) == (0, KNOCKOUT_LAYERS - 1)
    assert "(change of 2.00 spreads)" in reading_of(roles["language"])


@pytest.mark.parametrize(("change", "is_read"), [(0.05, False), (0.5, True)])
def test_without_a_control_of_that_size_a_tenth_of_the_spread_counts(change: float, is_read: bool) -> None:
    """A control that cut nothing is none."""
    outcomes = unmoved_by_pictures(knockout_of({"image": []}, 0), {"image": change})
    log = outcomes.edit_log.copy()
    log[[cell.is_control for cell in outcomes.cells]] = 0
    rows = read_by(replace(outcomes, edit_log=log))["image"]
    assert (layers_read(rows) is not None) == is_read
    assert rows[0].control_size is None


@pytest.mark.parametrize(("change", "is_read"), [(0.05, False), (0.5, True)])
@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_frames_without_a_control_do_not_weaken_that_of_the_others(
    change: float, is_read: bool, share: float
) -> None:
    """Cut and control change 0.05 alike, or the cut ten times as much; short instructions leave no control."""
    outcomes = unmoved_by_pictures(knockout_of({"image": []}, 0), {"image": change})
    assert outcomes.size is not None
    size, log = outcomes.size.copy(), outcomes.edit_log.copy()
    size += np.random.default_rng(0).normal(0, 0.005, size.shape)
    is_control = np.array([cell.is_control for cell in outcomes.cells])
    is_short = np.arange(KNOCKOUT_EPISODES) < share * KNOCKOUT_EPISODES
    size[np.ix_(is_control, ~is_short)] += 0.05
    log[np.ix_(is_control, is_short)] = 0
    rows = read_by(replace(outcomes, size=size, edit_log=log))["image"]
    assert (layers_read(rows) is not None) == is_read
    assert rows[0].control_size == pytest.approx(0.05, abs=0.005)


def in_an_environment(success: dict[str, float], groups: int = 12) -> ConditionOutcomes:
    """Episodes without sides; `success` is by condition the share of episodes that succeed, `clean` among them."""
    of_scene = knockout_of({"image": []}, 0, str(KNOCKOUT_LAYERS))
    names = ("clean", *of_scene.conditions[2:])
    rows = [0, *range(2, len(of_scene.conditions))]
    count = KNOCKOUT_EPISODES
    ends = np.array([np.arange(count) % 12 < 12 * success[name.rpartition("|")[2]] for name in names])
    cells = of_scene.cells
    return replace(
        of_scene,
        conditions=names,
        **columns_of([cells[row] for row in rows]),
        items=np.array([f"item-{number}" for number in range(count)]),
        groups=np.array([f"group-{number % groups}" for number in range(count)]),
        sides=np.full(count, ""),
        displacement=ends.astype(np.float64),
        max_action_change=np.zeros(ends.shape),
        edit_log=np.ones((*ends.shape, 5)),
        episode_outcomes=np.where(ends, "success", "failure"),
        toward=None,
        size=None,
    )


def test_in_an_environment_a_cut_loses_success_beyond_its_controls() -> None:
    """Of twelve episodes in a round nine succeed, three with the cut, and eight with the first control."""
    shares = {"clean": 9 / 12, "cut": 3 / 12, "control-1": 8 / 12, "control-2": 9 / 12}
    (row,) = read_by(in_an_environment(shares))["image"]
    assert (row.success_clean, row.success, row.lost) == (0.75, 0.25, 0.5)
    assert row.lost_ci is not None
    assert row.lost_ci[0] < 0.5 < row.lost_ci[1]
    assert row.control_lost == pytest.approx(1 / 24)
    assert layers_read([row]) == (0, KNOCKOUT_LAYERS - 1)
    assert reading_of([row]) == (
        "the action reads image in layers 0 to 5 (loss of 50 [25, 75] percentage points: success 25.0 % instead "
        "of 75.0 %)"
    )


@pytest.mark.parametrize(
    ("shares", "verdict"),
    [
        (
            {"clean": 0.75, "cut": 0.25, "control-1": 0.25, "control-2": 0.25},
            "not shown that success needs image",
        ),
        (
            {"clean": 0.75, "cut": 0.75, "control-1": 0.75, "control-2": 0.75},
            "not shown that success needs image",
        ),
        ({"clean": 0.0, "cut": 0.0, "control-1": 0.0, "control-2": 0.0}, "action reads image is unknown"),
    ],
)
def test_what_controls_lose_as_well_is_not_needed_and_without_success_nothing_is_known(
    shares: dict[str, float], verdict: str
) -> None:
    rows = read_by(in_an_environment(shares))["image"]
    assert layers_read(rows) is None
    assert verdict in reading_of(rows)
    assert f"its controls lose {100 * (shares['clean'] - shares['cut']):.0f} points" in reading_of(rows)


def test_too_few_groups_of_items_make_the_verdict_unknown() -> None:
    """One group less than can be significant, and as many as can."""
    shares = {"clean": 1.0, "cut": 0.0, "control-1": 1.0, "control-2": 1.0}
    few, enough = (knockout_effects(in_an_environment(shares, groups)) for groups in (4, 5))
    context: Any = None
    assert Knockout.finding([row for row in few if not row.is_control], context) == (
        "unknown: with 4 groups of items no p can be below 0.062; 5 groups or more can show what is read"
    )
    assert Knockout.finding([row for row in enough if not row.is_control], context).startswith("read: image")
    assert "(with 4 groups of items no p can be below 0.062" in Knockout.sentence(few, context)


@pytest.mark.parametrize(
    ("numbers", "sentence"),
    [
        ((36, 9, 9), "image: a cut hides 36 tokens, a control all 9 others, fewer than the cut. Nothing is drawn"),
        ((8, 37, 8), "image: a cut hides 8 tokens, a control 8 random ones of the 37 others."),
        ((36, 9, 0), "image: a cut hides 36 tokens. There is no control; 9 tokens have other roles."),
    ],
)
def test_notes_say_how_many_tokens_are_cut_and_how_many_a_control_is_drawn_from(
    numbers: tuple[int, int, int], sentence: str
) -> None:
    outcomes = knockout_of({"image": []}, 0)
    cut, remaining, control = numbers
    counts = np.zeros((*outcomes.displacement.shape, 2), np.int64)
    for row, cell in enumerate(outcomes.cells):
        counts[row] = (control, remaining) if cell.is_control else (cut, remaining)
    notes = Knockout.notes(knockout_effects(replace(outcomes, token_counts=counts)))
    assert notes[0].startswith(sentence)
    assert not any("hides" in note for note in Knockout.notes(knockout_effects(outcomes)))


def test_places_of_kv_are_cut_in_the_layer_that_reads_them_and_parts_are_refused(
    session: ReplaySession, twin: "Policy"
) -> None:
    conditions = Knockout(roles=("kv.*", "image"), window="first").conditions(session)
    cells = [condition.cell for condition in conditions if condition.cell.role.startswith("kv")]
    assert [(cell.site, cell.role, cell.direction) for cell in cells] == [
        (f"expert.0{block}-0{block}.heads", f"kv.0{block}", "cut") for block in range(3)
    ]
    (pair, _) = session.pairs(str(session.run.episodes["item_id"].iloc[0]))
    blocked = next(condition for condition in conditions if condition.cell.role == "kv.01")
    played = blocked.play(ConditionContext(session, pair))
    valid = PairTokens(twin, pair).mask("backbone", "all")
    sites = [site for site in twin.streams["expert"].sites("heads") if site.layer == 1]
    with cut_attention(twin, dict.fromkeys(sites, AttentionCut(valid))):
        np.testing.assert_array_equal(played.chunk, session.act(pair.clean, pair.seed))
    assert played.token_counts == (valid.sum(), 0)
    for options, message in (
        ({"roles": ("kv.01.keys",)}, "is a part of a place"),
        ({"roles": ("kv.01",), "readers": "language"}, "is what the acting part reads of it"),
    ):
        with pytest.raises(UsageError, match=message):
            Knockout(**options).conditions(session)  # type: ignore[arg-type]
    with pytest.raises(UnknownSiteError, match="has 4 layers"):
        Knockout(roles=("kv.07",)).conditions(session)


def test_controls_that_cut_all_other_tokens_are_one_inference(
    session: ReplaySession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A picture of the embedded policy has more tokens than all others together; words do not."""
    calls: list[int] = []
    act = session.act
    monkeypatch.setattr(session, "act", lambda *inputs: (calls.append(1), act(*inputs))[1])
    (pair, _) = session.pairs(str(session.run.episodes["item_id"].iloc[0]))
    for role, inferences in (("image", 2), ("language", 4)):
        context = ConditionContext(session, pair)
        kind = Knockout(roles=(role,), window="3", controls=3)
        calls.clear()
        results = [condition.play(context) for condition in kind.conditions(session)[2:]]
        assert len(calls) == inferences
        assert len(results) == 4
        assert all(result.edit_log is not None and result.edit_log.fires for result in results)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"window": "0"}, "expected both, first, last or a number"),
        ({"window": "half"}, "expected both, first, last or a number"),
        ({"roles": ("all",)}, "leaves no token of another role"),
        ({"readout": "per-step"}, "measures the first inference"),
    ],
)
def test_settings_that_mean_nothing_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Knockout(**settings)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_knockout_of_a_run_is_stored_and_read_again(copy: Run) -> None:
    command = ["intervene", str(copy.path), "--kind", "knockout", "--items", "2", "--window", "3"]
    answer = CliRunner().invoke(app, [*command, "--controls", "1"])
    assert answer.exit_code == 0, answer.output
    assert "layers 0 to 2" in answer.stdout
    again = CliRunner().invoke(app, [*command, "--controls", "1"])
    assert "loaded the stored result" in again.stderr
    assert again.stdout == answer.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_what_a_policy_reads_by_construction_is_named(name: str, tmp_path: Path) -> None:
    """`benchmarks/knockout_organisms.py` has twenty draws of each."""
    edit, truth = READERS[name]
    run, load = reader_run(edit, tmp_path / "run", seed=0)
    rows = by_role(run_intervention(run, Knockout(), load=load).effects)
    assert all(is_true_of(layers, layers_read(rows[role])) for role, layers in truth.items())


@pytest.mark.slow
def test_a_cut_in_closed_loop_shows_success_rates_with_and_without_it(copy: Run) -> None:
    command = ["intervene", str(copy.path), "--kind", "knockout", "--items", "1", "--window", "3"]
    answer = CliRunner().invoke(app, [*command, "--controls", "0", "--roles", "image", "--closed-loop"])
    assert answer.exit_code == 0, answer.output
    assert "success % (without)" in answer.stdout
    played = next(result for result in stored_interventions(copy) if result.settings.get("closed_loop"))
    effect = InterventionResult.of_stored(played).effects[0]
    of_category = copy.episodes[copy.episodes["category"] == effect.category]
    repeated = of_category[of_category["item_id"].isin(played.outcomes.items)]
    assert effect.success_clean == pytest.approx((repeated["outcome"] == "correct").mean())


@pytest.mark.slow
def test_the_same_cut_in_an_untrained_network_is_shown_beside_it(
    copy: Run, small_suite: Suite, tmp_path: Path
) -> None:
    """The recorded run has random weights; a trained policy plays the same items."""
    command = ["--kind", "knockout", "--window", "3", "--controls", "0", "--roles", "image"]
    trained = tmp_path / "trained"
    scene = SceneSpec.from_json(copy.settings["scene"], {})
    settings = ExtractSettings("pi0-tiny", suite=small_suite.folder, items=6, scene=scene, env_workers=0)
    extract_run(settings, trained)
    runner = CliRunner()
    before = runner.invoke(app, ["intervene", str(trained), *command, "--untrained", str(copy.path)])
    assert "stores no knockout with these options" in before.stderr
    assert runner.invoke(app, ["intervene", str(copy.path), *command]).exit_code == 0
    answer = runner.invoke(app, ["intervene", str(trained), *command, "--untrained", str(copy.path)])
    assert answer.exit_code == 0, answer.output
    assert "untrained" in answer.stdout
    fewer = runner.invoke(
        app, ["intervene", str(trained), *command, "--items", "2", "--untrained", str(copy.path)]
    )
    assert "stores this knockout of other items" in fewer.stderr
    seeded = runner.invoke(
        app, ["intervene", str(trained), *command, "--seed", "3", "--untrained", str(copy.path)]
    )
    assert "the newest one has other seed" in seeded.stderr
    (stored,) = stored_interventions(open_run(trained))
    twin = {row.category: row.size for row in knockout_effects_of(copy)}
    for row in InterventionResult.of_stored(stored).effects:
        assert row.untrained_size == pytest.approx(twin[row.category])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": "pi0"}, "has another family: 'pi0'; expected 'pi0-tiny'"),
        ({"suite": {"identity": "other@1"}}, "has another suite"),
        ({"seed": 7}, "has another seed: 7; expected 0"),
        ({"execute": 1}, "has another number of executed actions: 1"),
        ({"scene": {"picture_size": [640, 480]}}, r"has another scene \(.*picture_size"),
        ({"dtype": "bfloat16"}, "has another dtype: 'bfloat16'"),
    ],
)
def test_an_untrained_network_of_another_experiment_is_refused_by_what_differs(
    copy: Run, changes: dict[str, object], message: str
) -> None:
    scene = copy.settings["scene"] | changes.get("scene", {})  # type: ignore[operator]
    location = SimpleNamespace(address="elsewhere")
    other: Any = SimpleNamespace(
        settings={**copy.settings, **changes, "scene": scene}, random_weights=True, location=location
    )
    with pytest.raises(UsageError, match=message):
        stored_twin(Knockout(roles=("image",)), copy, other)


def knockout_effects_of(run: Run) -> list[KnockoutEffect]:
    """Of the newest stored knockout that plays no episodes."""
    results = [stored for stored in stored_interventions(run) if not stored.settings.get("closed_loop")]
    return list(InterventionResult.of_stored(max(results, key=lambda stored: stored.newest)).effects)
