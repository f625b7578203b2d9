"""Transfer of probes between runs: what transfers, what does not, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.metrics import balanced_accuracy_score, r2_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import SettingsMismatchError, TooFewGroupsError, UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs import open_run
from probe_kit.suite import Suite
from probe_kit.train import ArrayRun, Target, transfer_probes
from tests.support.labelled_run import write_labelled_run

SITES = [Site("backbone", 0), Site("backbone", 1)]
GROUPS, WIDTH = 30, 8
Array = NDArray[np.float64]


def run_of(
    name: str,
    seed: int,
    planted: Array | None = None,
    shift: float = 0.0,
    weights: str = "a" * 64,
    groups: str = "",
) -> ArrayRun:
    """Two episodes per group; `planted` (E,) lies along the first feature of the second site."""
    draw = np.random.default_rng([7, seed])
    names = [f"{name}{number}" for number in range(2 * GROUPS)]
    episodes = pd.DataFrame(
        {
            "episode_id": names,
            "group_id": [f"{groups or name}-g{number // 2}" for number in range(2 * GROUPS)],
            "category": "color",
            "layout": ["original", "swapped"] * GROUPS,
        }
    )
    features: dict[tuple[Site, str], Any] = {
        (site, "mean"): draw.normal(size=(2 * GROUPS, WIDTH)).astype(np.float32) for site in SITES
    }
    if planted is not None:
        features[SITES[1], "mean"][:, 0] += 3 * planted
    features[SITES[1], "mean"][:, 0] += shift
    return ArrayRun(Path("nowhere") / name, "none", f"suite-of-{name}", episodes, features, weights_sha256=weights)


def labels_of(run: ArrayRun, values: Any, name: str = "y", **options: Any) -> Target:
    return Target.read(pd.DataFrame({"episode_id": run.episodes["episode_id"], name: values}), name, **options)


def quantity(seed: int) -> Array:
    """A label per episode, alike in a group."""
    draw = np.random.default_rng([8, seed])
    return np.asarray(np.repeat(draw.normal(size=GROUPS), 2) + 0.3 * draw.normal(size=2 * GROUPS))


def pair(shift: float = 0.0) -> tuple[ArrayRun, ArrayRun, Array, Array]:
    source_values, target_values = quantity(0), quantity(1)
    return run_of("a", 0, source_values), run_of("b", 1, target_values, shift), source_values, target_values


def test_a_planted_quantity_transfers_and_scikit_learn_agrees() -> None:
    run, other, source_values, target_values = pair()
    results = transfer_probes(
        run, other, labels_of(run, source_values), labels_of(other, target_values), permutations=99
    )
    scores = results.scores.set_index("layer")
    assert scores.loc[1, "p_fwe"] == 0.01
    assert scores.loc[1, "score"] > 0.7
    assert scores.loc[1, "ci_low"] < scores.loc[1, "score"] < scores.loc[1, "ci_high"]
    assert scores.loc[0, "p_fwe"] > 0.05
    assert scores.loc[1, "chance"] < 0
    assert results.trained_on == {"samples": 2 * GROUPS, "groups": GROUPS}
    for site in SITES:
        model = make_pipeline(StandardScaler(), Ridge(alpha=float(scores.loc[site.layer, "penalty"])))
        if np.isinf(scores.loc[site.layer, "penalty"]):
            predicted = np.full(target_values.size, source_values.mean())
        else:
            model.fit(run.features[site, "mean"].astype(float), source_values)
            predicted = model.predict(other.features[site, "mean"].astype(float)).clip(
                source_values.min(), source_values.max()
            )
        assert scores.loc[site.layer, "score"] == pytest.approx(r2_score(target_values, predicted), abs=1e-10)


def test_a_binary_label_is_scored_as_scikit_learn_does() -> None:
    run, other, source_values, target_values = pair()
    truth = [values > np.quantile(values, 0.3) for values in (source_values, target_values)]
    results = transfer_probes(run, other, labels_of(run, truth[0]), labels_of(other, truth[1]), permutations=19)
    row = results.scores.set_index("layer").loc[1]
    model = make_pipeline(StandardScaler(), LogisticRegression(C=1 / row["penalty"], tol=1e-10, max_iter=10_000))
    model.fit(run.features[SITES[1], "mean"].astype(float), truth[0])
    share = truth[0].mean()
    predicted = model.decision_function(other.features[SITES[1], "mean"].astype(float)) > np.log(
        share / (1 - share)
    )
    assert row["score"] == pytest.approx(balanced_accuracy_score(truth[1], predicted))
    assert row["score"] > 0.7


def test_classes_are_matched_by_name() -> None:
    run, other, source_values, target_values = pair()
    names = np.array(["low", "middle", "high"])
    first, second = (names[np.digitize(values, [-0.5, 0.5])] for values in (source_values, target_values))
    results = transfer_probes(run, other, labels_of(run, first), labels_of(other, second), permutations=19)
    assert results.classes == ("high", "low", "middle")
    assert results.scores.set_index("layer").loc[1, "score"] > 0.6
    fewer = np.where(second == "high", "middle", second)
    with pytest.raises(SettingsMismatchError, match=r"\(binary, per episode\)"):
        transfer_probes(run, other, labels_of(run, first), labels_of(other, fewer), permutations=0)
    of_both = [labels_of(run, first, task="classes"), labels_of(other, np.where(second == "low", "tiny", second))]
    with pytest.raises(UsageError, match="the class 'tiny', which no probe was fitted to"):
        transfer_probes(run, other, *of_both, permutations=0)
    of_two = transfer_probes(
        run, other, labels_of(run, first), labels_of(other, fewer, task="classes"), permutations=0
    )
    assert of_two.classes == ("low", "middle")
    fitted_decisions = of_two.curves["mean"].fitted.decisions[1]
    assert set(fitted_decisions) <= {-1.0, 0.0, 1.0}, "a class that the other run lacks is never right"


def test_a_shift_of_all_features_is_undone_by_recentring_alone() -> None:
    run, other, source_values, target_values = pair(shift=25.0)
    moved = transfer_probes(
        run, other, labels_of(run, source_values), labels_of(other, target_values), permutations=19
    )
    row = moved.scores.set_index("layer").loc[1]
    assert row["score"] < 0
    assert row["recentred"] > 0.6
    assert row["refitted"] > 0.7


def test_labels_of_the_other_run_take_part_in_no_fit() -> None:
    run, other, source_values, target_values = pair()
    transfer = transfer_probes(
        run, other, labels_of(run, source_values), labels_of(other, target_values), permutations=0
    )
    two = transfer_probes(
        run, other, labels_of(run, source_values), labels_of(other, -target_values), permutations=0
    )
    np.testing.assert_array_equal(transfer.curves["mean"].fitted.decisions, two.curves["mean"].fitted.decisions)


@pytest.mark.slow
def test_unrelated_labels_transfer_as_often_as_p_says() -> None:
    """Of 60 label pairs that know nothing of the features, alike in groups; 0.05 and two standard errors."""
    p_values = []
    for seed in range(60):
        run, other = run_of("a", 100 + seed), run_of("b", 300 + seed)
        labels = labels_of(run, quantity(500 + seed)), labels_of(other, quantity(700 + seed))
        p_values.append(transfer_probes(run, other, *labels, permutations=19).scores["p_fwe"].min() <= 0.05)
    assert np.mean(p_values) <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / 60)


def test_groups_that_both_runs_have_are_left_out() -> None:
    source_values, target_values = quantity(0), quantity(1)
    run, other = run_of("a", 0, source_values, groups="kitchen"), run_of("b", 1, target_values, groups="kitchen")
    names = other.episodes["group_id"].where(other.episodes.index >= 20, "own-" + other.episodes["group_id"])
    other.episodes["group_id"] = names
    tables = [
        Target.read(
            pd.DataFrame({"episode_id": labelled_run.episodes["episode_id"], "y": y}), "y", group_by="group_id"
        )
        for labelled_run, y in ((run, source_values), (other, target_values))
    ]
    results = transfer_probes(run, other, *tables, permutations=0)
    assert results.left_out == {"groups that both runs have": 20}
    assert set(results.groups) == {f"own-kitchen-g{number}" for number in range(10)}
    with pytest.raises(TooFewGroupsError, match=r"30 of the 30 groups of .*leaves 0; expected at least 5"):
        transfer_probes(run, run, tables[0], tables[0], permutations=0)


def test_other_weights_sites_and_definitions_are_refused() -> None:
    run, other, source_values, target_values = pair()
    labels, other_labels = labels_of(run, source_values), labels_of(other, target_values)
    strange = run_of("b", 1, target_values, weights="b" * 64)
    with pytest.raises(SettingsMismatchError, match=r"aaaaaaaaaaaa, .* bbbbbbbbbbbb.*--across-weights"):
        transfer_probes(run, strange, labels, labels_of(strange, target_values))
    accepted = transfer_probes(
        run, strange, labels, labels_of(strange, target_values), permutations=0, across_weights=True
    )
    assert not accepted.same_weights
    unknown = run_of("b", 1, target_values, weights="")
    with pytest.raises(SettingsMismatchError, match="unknown"):
        transfer_probes(run, unknown, labels, labels_of(unknown, target_values))
    del other.features[SITES[0], "mean"]  # type: ignore[attr-defined]
    with pytest.raises(SettingsMismatchError, match=r"2 sites, .* 1, .*backbone\.00\.residual"):
        transfer_probes(run, other, labels, other_labels)
    full_run = run_of("b", 1, target_values)
    with pytest.raises(SettingsMismatchError, match=r"column of a table 'y' .*column of a table 'z'"):
        transfer_probes(run, full_run, labels, labels_of(full_run, target_values, "z"))


@pytest.mark.slow
def test_the_command_prints_the_transfer_beside_the_other_runs_own_score(
    small_suite: Suite, tmp_path: Path
) -> None:
    first, *_, last = small_suite.categories
    for name, category, seed in (("a", first, 0), ("b", last, 1)):
        write_labelled_run(tmp_path / name, small_suite.select([category]), seed)

    def printed_transfer(*words: str) -> str:
        answer = CliRunner().invoke(app, ["train", str(tmp_path / "a"), *words], env={"COLUMNS": "200"})
        return " ".join((answer.stdout + answer.stderr).split())

    target = ["--target", "sim.tool_y", "--permutations", "19"]
    transferred = printed_transfer(*target, "--test-on", str(tmp_path / "b"))
    assert "transfers in the backbone at backbone.01.residual" in transferred
    assert "nothing was stored" in transferred
    assert not (tmp_path / "a" / "probes").exists()
    assert "groups of" in printed_transfer(*target, "--test-on", str(tmp_path / "a"))
    side = printed_transfer("--permutations", "19", "--test-on", str(tmp_path / "b"))
    assert "correct: balanced accuracy" in side, "a side transfers as any label"
    assert "--across-weights is for a transfer" in printed_transfer(*target, "--across-weights")
    assert "--jobs is not for a transfer" in printed_transfer(
        *target, "--test-on", str(tmp_path / "b"), "--jobs", "2"
    )
    assert open_run(tmp_path / "b").sealed
