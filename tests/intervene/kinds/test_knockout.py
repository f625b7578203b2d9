"""Attention knockout: windows, controls, losses of policies whose reading is known, and sentences."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.intervene import ConditionOutcomes, InterventionResult, Knockout, run_intervention
from probe_kit.intervene.kinds.knockout import (
    KnockoutEffect,
    by_role,
    knockout_effects,
    layers_read,
    random_tokens,
    reading_of,
    windows,
)
from probe_kit.intervene.stored import stored_interventions
from probe_kit.runs import Run, open_run
from probe_kit.suite import Suite
from tests.intervene.answers import KNOCKOUT_EPISODES, KNOCKOUT_LAYERS, knockout_of
from tests.support.organisms import READERS, is_true_of, reader_run

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
    settings = ExtractSettings("pi0-tiny", suite=small_suite.folder, items=6, max_steps=2, env_workers=0)
    extract_run(settings, trained)
    runner = CliRunner()
    before = runner.invoke(app, ["intervene", str(trained), *command, "--untrained", str(copy.path)])
    assert "stores no knockout with these roles" in before.stderr
    assert runner.invoke(app, ["intervene", str(copy.path), *command]).exit_code == 0
    answer = runner.invoke(app, ["intervene", str(trained), *command, "--untrained", str(copy.path)])
    assert answer.exit_code == 0, answer.output
    assert "untrained" in answer.stdout
    (stored,) = stored_interventions(open_run(trained))
    twin = {row.category: row.size for row in knockout_effects_of(copy)}
    for row in InterventionResult.of_stored(stored).effects:
        assert row.untrained_size == pytest.approx(twin[row.category])


def knockout_effects_of(run: Run) -> list[KnockoutEffect]:
    """Of the newest stored knockout that plays no episodes."""
    results = [stored for stored in stored_interventions(run) if not stored.settings.get("closed_loop")]
    return list(InterventionResult.of_stored(max(results, key=lambda stored: stored.newest)).effects)
