"""Erasing inside a real network: what is written, what the ledger says, and what the numbers are called."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray
from sklearn.covariance import ledoit_wolf_shrinkage
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import LinearRegression, LogisticRegression

from probe_kit.errors import UsageError
from probe_kit.intervene import (
    ConceptErasure,
    ConditionOutcomes,
    InterventionResult,
    ReplayFiles,
    load_effects,
    run_intervention,
    stored_image_swaps,
)
from probe_kit.intervene.erasers import (
    Eraser,
    Method,
    PaddedTokens,
    fit_control,
    fit_eraser,
    leace_direction,
    ledoit_wolf,
)
from probe_kit.intervene.kinds.erase import ErasureEffect
from probe_kit.runs import Run, open_run, verify_run
from tests.intervene.answers import follower, habit, measured, outcomes_of

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


ASKED = ConceptErasure(categories=("color",), items=6, sites=("backbone.02", "backbone.03"), controls=1)
EPISODES = 12


@pytest.fixture(scope="module")
def effects(copy: Run, source: ReplayFiles, twin: "Policy") -> InterventionResult:
    return run_intervention(copy, ASKED, source, load=lambda *_: twin)


def row_of(effects: InterventionResult, sites: str, direction: str) -> ErasureEffect:
    (row,) = (row for row in effects.effects if (row.sites, row.direction) == (sites, direction))
    return row


@pytest.mark.slow
def test_writing_back_what_is_there_changes_no_action_bit_for_bit(effects: InterventionResult) -> None:
    row = row_of(effects, "backbone.02", "none")
    assert (row.finding, row.max_action_change, row.fires, row.no_op_fires) == (
        "identity patch",
        0.0,
        EPISODES,
        EPISODES,
    )


@pytest.mark.slow
def test_erasing_a_read_answer_changes_the_action_and_erasing_an_unread_one_does_not(
    effects: InterventionResult,
) -> None:
    for name in ("leace", "control-1"):
        read, unread = (row_of(effects, site, name) for site in ("backbone.02", "backbone.03"))
        assert read.fires == unread.fires == EPISODES
        assert read.no_op_fires == unread.no_op_fires == 0
        assert min(read.relative_change, unread.relative_change) > 0
        assert read.max_action_change > 0
        assert unread.max_action_change == 0.0
        assert unread.net == 0.0


@pytest.mark.slow
def test_the_certificate_says_what_a_fresh_probe_reads(effects: InterventionResult) -> None:
    accuracies = effects.certificate["probe_accuracy"]
    assert set(accuracies) == {
        f"{site}|image|{what}"
        for site in ("backbone.02", "backbone.03")
        for what in ("none|0", "leace", "control-1")
    }
    assert all(0 <= share <= 1 for by_probe in accuracies.values() for share in by_probe.values())
    row = row_of(effects, "backbone.02", "leace")
    assert (row.probe_accuracy_before, row.probe_accuracy) == tuple(
        accuracies[f"backbone.02|image|{what}"]["color"] for what in ("none|0", "leace")
    )


@pytest.mark.slow
def test_it_is_stored_apart_from_other_kinds_and_read_back(copy: Run, effects: InterventionResult) -> None:
    assert load_effects(copy, kind="erase").to_json() == effects.to_json()
    assert stored_image_swaps(copy) == {}
    assert verify_run(copy.path, deep=True).ok
    assert "weaker evidence than interchange" in " ".join(effects.notes)
    stored = (copy.path / "interventions" / effects.key / "effects.csv").read_text(encoding="utf-8")
    assert stored.splitlines()[0].split(",")[:4] == ["category", "sites", "role", "direction"]


@pytest.mark.slow
def test_killed_and_resumed_gives_the_same_bytes(
    copy: Run, effects: InterventionResult, source: ReplayFiles, twin: "Policy", tmp_path: Path
) -> None:
    mine = open_run(shutil.copytree(copy.path, tmp_path / "run"))
    folder = mine.path / "interventions" / effects.key
    shutil.rmtree(folder)

    def stop(finished: int, *_: object) -> None:
        if finished == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_intervention(mine, ASKED, source, load=lambda *_: twin, progress=stop)
    assert run_intervention(mine, ASKED, source, load=lambda *_: twin).key == effects.key
    for name in ("episodes.npz", "effects.csv", "certificate.json"):
        assert (folder / name).read_bytes() == (copy.path / "interventions" / effects.key / name).read_bytes()


# -- what the numbers are called -------------------------------------------------------------------------------


def erased_answers(erasure_share: float, control_share: float, base: str = "follower") -> ConditionOutcomes:
    """Actions that keep the share `erasure_share` of how far they go, and `control_share` under two controls."""
    outcomes = outcomes_of({"color": {"follower": follower, "habit": habit}[base](24)})
    plain = outcomes.of("clean")
    rows = np.array([plain, erasure_share * plain, control_share * plain, control_share * plain])
    cell = "backbone.02|image"
    return replace(
        outcomes,
        conditions=("clean", f"{cell}|leace", f"{cell}|control-1", f"{cell}|control-2"),
        displacement=rows,
        max_action_change=np.abs(rows - rows[0]),
        edit_log=np.zeros((4, plain.size, 5)),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("erasure_share", "control_share", "base", "finding"),
    [
        (0.1, 0.95, "follower", "effect"),
        (-0.5, 0.9, "follower", "effect"),
        (0.9, 0.95, "follower", "no effect"),
        (0.05, 0.3, "follower", "controls also disrupt"),
        (0.1, 0.95, "habit", "no baseline effect"),
    ],
)
def test_an_answer_counts_as_lost_only_beyond_the_controls(
    erasure_share: float, control_share: float, base: str, finding: str
) -> None:
    row, *controls = ConceptErasure.effects(measured(erased_answers(erasure_share, control_share, base), "suite"))
    assert row.finding == finding
    assert [effect.finding for effect in controls] == ["control", "control"]
    if finding == "no baseline effect":
        assert row.share_left is None
        return
    assert row.share_left == pytest.approx(erasure_share)
    assert row.control_share_left == pytest.approx(control_share)
    assert row.p is not None
    # Twelve items with the same sign: the smallest possible p.
    assert row.p == 2.0**-12
    assert row.right == (erasure_share > 0)


@pytest.mark.slow
def test_a_loss_in_one_group_is_no_evidence() -> None:
    outcomes = erased_answers(1.0, 1.0)
    first_group = outcomes.groups == outcomes.groups[0]
    outcomes.displacement[1] = np.where(first_group, -outcomes.displacement[0], outcomes.displacement[0])
    row = ConceptErasure.effects(measured(outcomes, "suite"))[0]
    assert row.net > 0
    assert row.p is not None
    assert row.p >= 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    "intervention",
    [
        lambda: ConceptErasure(sites=()),
        lambda: ConceptErasure(sites=("backbone.02",), roles=()),
        lambda: ConceptErasure(sites=("backbone.02",), method="zap"),
        lambda: ConceptErasure(sites=("backbone.02",), method="leace:3"),
    ],
)
def test_erase_refuses_impossible_settings(intervention: object) -> None:
    with pytest.raises(UsageError):
        intervention()  # type: ignore[operator]


@pytest.mark.slow
def test_ways_are_one_key_however_they_are_written() -> None:
    assert ConceptErasure(sites=("backbone.02",), method="inlp") == ConceptErasure(
        sites=("backbone.02",), method="inlp:5"
    )


POSITIONS, WIDTH = 3, 12
METHODS = [Method.of(name) for name in ("leace", "mean-difference:2", "inlp:3")]


def drawn(episodes: int = 120, gap: float = 2.0, seed: int = 0) -> tuple[PaddedTokens, NDArray[np.bool_]]:
    """Correlated noise, and an answer that lies elsewhere at every position."""
    draw = np.random.default_rng(seed)
    is_left = draw.permutation(np.arange(episodes) % 2 == 0)
    noise = draw.normal(size=(episodes, POSITIONS, WIDTH)) @ draw.normal(size=(WIDTH, WIDTH))
    where = draw.normal(size=(POSITIONS, WIDTH))
    values = noise + gap * is_left[:, None, None] * where + 5.0
    return PaddedTokens(values, np.ones((episodes, POSITIONS), bool)), is_left


def balanced(tokens: PaddedTokens, is_left: NDArray[np.bool_], positions: list[int]) -> PaddedTokens:
    """At these positions every value occurs as often with either answer, as before the first layer of a suite
    that asks of every picture both ways: class means differ by rounding alone.
    """
    values = tokens.values.copy()
    for position in positions:
        values[is_left, position] = values[np.flatnonzero(~is_left)[::-1], position]
    return PaddedTokens(values, tokens.present)


def test_after_leace_no_linear_probe_reads_anything_in_what_it_was_fitted_on() -> None:
    """Of any position, and of their mean: least squares explain nothing, logistic regression gives the prior."""
    tokens, is_left = drawn()
    erased = fit_eraser(tokens, is_left, Method())(tokens.values)
    views = [erased[:, position] for position in range(POSITIONS)] + [erased.mean(axis=1)]
    for before, after in zip([tokens.values[:, 0]] * len(views), views, strict=True):
        assert LinearRegression().fit(before, is_left).score(before, is_left) > 0.3
        assert LinearRegression().fit(after, is_left).score(after, is_left) == pytest.approx(0, abs=1e-8)
        assert LinearDiscriminantAnalysis().fit(after, is_left).decision_function(after).std() < 1e-3
        probe = LogisticRegression(C=1e4, max_iter=2000, tol=1e-8).fit(after, is_left)
        np.testing.assert_allclose(probe.predict_proba(after)[:, 1], is_left.mean(), atol=1e-3)


def test_leace_changes_the_least_of_all_that_leave_nothing_to_read() -> None:
    """Than the projection on the difference of means, and than INLP as soon as that leaves nothing either."""
    tokens, is_left = drawn(400)
    centred, _ = tokens.centred()
    values, label = centred[:, 0], is_left - is_left.mean()
    removed, read = leace_direction(values, label, shrinkage=0.0)
    leace_change = float((np.outer(values @ read, removed) ** 2).sum())
    along = removed / np.linalg.norm(removed)
    assert leace_change < float(((values @ along) ** 2).sum())
    only = PaddedTokens(tokens.values[:, :1], tokens.present[:, :1])
    for rank in range(1, WIDTH + 1):
        remaining = fit_eraser(only, is_left, Method("inlp", rank))(only.values)
        score = LinearRegression().fit(remaining[:, 0], is_left).score(remaining[:, 0], is_left)
        if score < 0.01:
            break
    assert score < 0.01
    assert leace_change < float(((remaining - only.values) ** 2).sum())


def test_leace_is_the_projection_of_its_paper() -> None:
    """W⁺ P W with W the whitening matrix and P the projection on the whitened covariance with the answer."""
    tokens, is_left = drawn()
    values = tokens.centred()[0][:, 0]
    label = is_left - is_left.mean()
    covariance = values.T @ values / len(values)
    sizes, axes = np.linalg.eigh(covariance)
    whiten, unwhiten = (axes @ np.diag(sizes**power) @ axes.T for power in (-0.5, 0.5))
    direction = whiten @ (values.T @ label)
    expected = unwhiten @ np.outer(direction, direction) / (direction @ direction) @ whiten
    removed, read = leace_direction(values, label, shrinkage=0.0)
    np.testing.assert_allclose(np.outer(removed, read), expected, atol=1e-8)


@pytest.mark.parametrize("episodes", [9, 40, 300])
def test_the_covariance_is_shrunk_as_ledoit_and_wolf_say(episodes: int) -> None:
    draw = np.random.default_rng(episodes)
    values = draw.normal(size=(episodes, 50)) * draw.uniform(0.1, 3, 50)
    centred = values - values.mean(axis=0)
    assert ledoit_wolf(centred) == pytest.approx(ledoit_wolf_shrinkage(centred, assume_centered=True))


def test_fewer_episodes_than_dimensions_are_erased_as_well() -> None:
    tokens, is_left = drawn(10)
    erased = fit_eraser(tokens, is_left, Method())(tokens.values)
    gap = erased[is_left].mean(axis=0) - erased[~is_left].mean(axis=0)
    np.testing.assert_allclose(gap, 0, atol=1e-5)


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_every_way_takes_the_difference_of_means_and_its_control_does_not(method: Method) -> None:
    tokens, is_left = drawn(gap=4.0)
    eraser = fit_eraser(tokens, is_left, method)
    control = fit_control(tokens, is_left, method, eraser, np.random.default_rng(0))

    def gap(values: NDArray[np.float64]) -> float:
        return float(np.linalg.norm(values[is_left].mean(axis=0) - values[~is_left].mean(axis=0)))

    before, after, after_control = (gap(values) for values in (
        tokens.values, eraser(tokens.values), control(tokens.values),
    ))  # fmt: skip
    assert after < 0.5 * before
    assert after_control > after + 0.3 * before
    assert eraser.removed.shape == control.removed.shape


@pytest.mark.parametrize("method", METHODS[1:], ids=str)
def test_directions_are_orthonormal_and_controls_stand_beside_them(method: Method) -> None:
    tokens, is_left = drawn()
    eraser = fit_eraser(tokens, is_left, method)
    control = fit_control(tokens, is_left, method, eraser, np.random.default_rng(0))
    for mine, other in zip(eraser.removed, control.removed, strict=True):
        np.testing.assert_allclose(mine @ mine.T, np.eye(method.rank), atol=1e-5)
        np.testing.assert_allclose(other @ other.T, np.eye(method.rank), atol=1e-5)
        np.testing.assert_allclose(mine @ other.T, 0, atol=1e-5)


def test_the_label_of_a_leace_control_is_uncorrelated_with_the_answer() -> None:
    tokens, is_left = drawn()
    eraser = fit_eraser(tokens, is_left, Method())
    control = fit_control(tokens, is_left, Method(), eraser, np.random.default_rng(0))
    remaining = control(tokens.values)[:, 0]
    assert LinearRegression().fit(remaining, is_left).score(remaining, is_left) > 0.3


def test_a_position_with_too_few_episodes_is_left_as_it_is() -> None:
    tokens, is_left = drawn()
    tokens.present[5:, 2] = False
    erase = fit_eraser(tokens, is_left, Method())
    assert erase.fitted.tolist() == [True, True, False]
    erased = erase(tokens.values)
    np.testing.assert_array_equal(erased[:, 2], tokens.values[:, 2])
    assert (erased[:, :2] != tokens.values[:, :2]).any()
    np.testing.assert_array_equal(erase(tokens.values[:, :2]), erased[:, :2])
    with pytest.raises(UsageError, match="4 episodes of either answer"):
        fit_eraser(tokens.only(np.arange(3)), is_left[:3], Method())


def test_erasing_is_in_place_of_nothing_else() -> None:
    """The means over both answers stay, and an eraser without a direction changes no bit."""
    tokens, is_left = drawn()
    for method in METHODS:
        erased = fit_eraser(tokens, is_left, method)(tokens.values)
        np.testing.assert_allclose(erased.mean(axis=0), tokens.values.mean(axis=0), atol=1e-4)
    none = np.zeros((1, 1, WIDTH))
    means = tokens.values.mean(axis=0)
    still = Eraser(means, none, none, np.ones(POSITIONS, bool))
    np.testing.assert_array_equal(still(tokens.values), tokens.values)


@pytest.mark.parametrize("name", ["", "lace", "leace:2", "inlp:0", "inlp:x", "mean-difference:-1"])
def test_ways_that_are_none_are_refused(name: str) -> None:
    with pytest.raises(UsageError):
        Method.of(name)


def test_ways_have_names() -> None:
    assert [str(Method.of(name)) for name in ("leace", "inlp", "mean-difference:2")] == [
        "leace", "inlp:5", "mean-difference:2",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "available"), [("mean-difference:4", POSITIONS), ("mean-difference:999", WIDTH), ("inlp:13", WIDTH)]
)
def test_no_name_is_kept_for_fewer_directions_than_it_says(name: str, available: int) -> None:
    tokens, is_left = drawn()
    with pytest.raises(
        UsageError, match=f"asks for .* have {available} to find; expected .*:{available} or fewer"
    ):
        fit_eraser(tokens, is_left, Method.of(name))


@pytest.mark.parametrize("offset", [0.0, 1e3])
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_rounding_is_no_direction(method: Method, offset: float) -> None:
    tokens, is_left = drawn()
    tokens = PaddedTokens(tokens.values + offset, tokens.present)
    with pytest.raises(UsageError, match=r"no direction.*later --sites"):
        fit_eraser(balanced(tokens, is_left, [0, 1, 2]), is_left, method)


@pytest.mark.parametrize("method", [Method.of(name) for name in ("leace", "inlp:3")], ids=str)
def test_a_position_that_says_nothing_of_the_answer_is_left_as_it_is(method: Method) -> None:
    """By the eraser and by its control, which would otherwise take away more than the eraser."""
    tokens, is_left = drawn()
    tokens = balanced(tokens, is_left, [1])
    tokens.values[:, 1, :6] = 7.0  # as a token that is the same in every instruction
    fitted_eraser = fit_eraser(tokens, is_left, method)
    for eraser in (fitted_eraser, fit_control(tokens, is_left, method, fitted_eraser, np.random.default_rng(0))):
        assert eraser.fitted.tolist() == [True, False, True]
        erased = eraser(tokens.values)
        np.testing.assert_array_equal(erased[:, 1], tokens.values[:, 1])
        assert (erased[:, [0, 2]] != tokens.values[:, [0, 2]]).any()


@pytest.mark.parametrize(("way", "most"), [("mean-difference", 1), ("inlp", 2)])
def test_controls_that_find_no_room_beside_it_are_refused(way: str, most: int) -> None:
    """In four dimensions a control of three directions has one that is beside, and would be called equal."""
    tokens, is_left = drawn()
    narrow = PaddedTokens(tokens.values[..., : 2 * most], tokens.present)
    fits = {rank: fit_eraser(narrow, is_left, Method.of(f"{way}:{rank}")) for rank in (most, most + 1)}
    control = fit_control(narrow, is_left, Method.of(f"{way}:{most}"), fits[most], np.random.default_rng(0))
    assert (np.linalg.norm(control.removed, axis=-1) > 0.99).all()
    with pytest.raises(UsageError, match=f"leaves room for {most - 1} random directions"):
        fit_control(narrow, is_left, Method.of(f"{way}:{most + 1}"), fits[most + 1], np.random.default_rng(0))
