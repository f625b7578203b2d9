"""One family of probes: what a side can, a column of labels can, and where not the message says why."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.hooks import Site
from probe_kit.runs import Run, open_run
from probe_kit.train import ArrayRun, Target, load_results, train_probes, transfer_probes
from probe_kit.train.results.inventory import inventory
from probe_kit.train.results.store import SweepCheckpoint
from tests.support.slow_cases import slow_but
from tests.train.conftest import episode_table

TASKS = ("binary", "classes", "continuous")

ITEMS, TOKENS, WIDTH = 40, 5, 6
SITES = Site("backbone", 0), Site("backbone", 1)
QUICK: dict[str, Any] = {"permutations": 19, "controls": ()}


def tokens_of(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(E, T, D) noise whose mean over an episode's tokens holds a quantity, and a mask of 3 to 5 tokens."""
    draw = np.random.default_rng(0)
    tokens = draw.normal(size=(values.size, TOKENS, WIDTH))
    tokens[:, :, 2] += 2 * values[:, None]
    mask = np.arange(TOKENS) < draw.integers(3, TOKENS + 1, values.size)[:, None]
    return tokens, mask


@pytest.fixture
def run(tmp_path: Path) -> ArrayRun:
    """Two categories; a group of items has a quantity `y`, which the tokens of the second layer hold."""
    episodes = pd.concat([episode_table(ITEMS, name) for name in ("color", "shape")], ignore_index=True)
    draw = np.random.default_rng(1)
    of_group = {name: draw.normal() for name in dict.fromkeys(episodes["group_id"])}
    episodes["y"] = episodes["group_id"].map(of_group)
    planted, mask = tokens_of(episodes["y"].to_numpy())
    noise, _ = tokens_of(np.zeros(len(episodes)))
    tokens = {(SITES[0], None): (noise, mask), (SITES[1], None): (planted, mask)}
    features = {(site, "mean"): values.mean(axis=1) for (site, _), (values, _) in tokens.items()}
    return ArrayRun(tmp_path / "run", "m", "s@1#0", episodes, features, token_features=tokens)


def target_of(run: ArrayRun, task: str) -> Target:
    y = run.episodes["y"].to_numpy()
    values = {
        "continuous": y,
        "binary": y > np.median(y),
        "classes": np.digitize(y, np.quantile(y, [1 / 3, 2 / 3])),
    }
    return Target.read(run.episodes[["episode_id"]].assign(label=values[task]), "label", task)  # type: ignore[arg-type]


@pytest.mark.parametrize("task", slow_but(["classes"], TASKS))
def test_every_token_is_a_sample_and_decides_as_the_mean_of_its_episode(run: ArrayRun, task: str) -> None:
    results = train_probes(run, target=target_of(run, task), views=("tokens", "mean"), **QUICK)
    scores = results.scores.set_index(["view", "layer"])["score"]
    assert scores["tokens", 1] > 0.5 >= scores["tokens", 0]
    assert results.settings.token_permutations == 19
    curve = results.curves["all", "tokens"]
    assert curve.null.shape == (2, 19)
    alone = train_probes(
        run, target=target_of(run, task), views=("tokens",), permutations=19, token_permutations=5, controls=()
    )
    assert alone.curves["all", "tokens"].null.shape == (2, 5), "as many as were asked for"
    assert alone.scores["smallest_p"].iloc[0] == pytest.approx(1 / 6)


def test_ridge_on_tokens_is_ridge_of_scikit_learn_on_every_token(run: ArrayRun) -> None:
    from sklearn.linear_model import Ridge
    from sklearn.preprocessing import StandardScaler

    results = train_probes(
        run, target=target_of(run, "continuous"), views=("tokens",), permutations=0, controls=()
    )
    curve, (values, mask) = results.curves["all", "tokens"], run.token_features[SITES[1], None]
    for number, fold in enumerate(curve.folds()):
        train = np.concatenate([values[row][mask[row]] for row in fold.train]).astype(np.float32)
        y = np.repeat(curve.labels[fold.train], mask[fold.train].sum(axis=1))
        scaler = StandardScaler().fit(train)
        means = np.stack([values[row][mask[row]].astype(np.float32).mean(axis=0) for row in fold.test])
        model = Ridge(alpha=curve.strengths[1, number]).fit(scaler.transform(train), y)
        expected = model.predict(scaler.transform(means)).clip(y.min(), y.max())
        np.testing.assert_allclose(curve.decisions[1, fold.test], expected, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("target", ["side.correct", "label"])
def test_categories_are_probed_one_by_one_or_pooled(run: ArrayRun, target: str) -> None:
    of = "side.correct" if target == "side.correct" else target_of(run, "continuous")
    each = train_probes(run, ("shape", "color"), target=of, **QUICK)
    assert list(dict.fromkeys(each.scores["category"])) == ["shape", "color"]
    assert (each.scores["n"] == 2 * ITEMS).all()
    pooled = train_probes(run, ("all",), target=of, **QUICK)
    assert (pooled.scores["n"] == 4 * ITEMS).all()
    default = train_probes(run, target=of, **QUICK)
    assert set(default.settings.categories) == ({"color", "shape"} if target == "side.correct" else {"all"})


def test_a_class_that_only_another_category_has_does_not_count(run: ArrayRun) -> None:
    of_group = {name: number % 2 for number, name in enumerate(dict.fromkeys(run.episodes["group_id"]))}
    kind = run.episodes["category"] + run.episodes["group_id"].map(of_group).astype(str)
    target = Target.read(run.episodes[["episode_id"]].assign(label=kind), "label", "classes")
    each = train_probes(run, ("color", "shape"), target=target, permutations=0, controls=())
    assert each.curves["color", "mean"].classes == ("color0", "color1")
    assert each.curves["shape", "mean"].classes == ("shape0", "shape1")


@pytest.mark.parametrize("target", ["side.correct", "label"])
def test_an_interrupted_sweep_continues_after_the_last_finished_site(run: ArrayRun, target: str) -> None:
    of = "side.correct" if target == "side.correct" else target_of(run, "continuous")

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_probes(run, ("all",), target=of, progress=stop, **QUICK)
    ((key, sites),) = inventory(run).unfinished.items()
    assert sites == 1
    assert SweepCheckpoint.of(run.location, key).read("mean", SITES[0]) is not None
    progress_counts: list[int] = []
    results = train_probes(run, ("all",), target=of, progress=lambda *at: progress_counts.append(at[0]), **QUICK)
    assert (results.key, progress_counts) == (key, [2])


@pytest.mark.parametrize("target", ["side.correct", "label"])
def test_incomplete_items_can_be_dropped_for_every_target(run: ArrayRun, target: str) -> None:
    keep = np.ones(len(run.episodes), bool)
    keep[:6:2] = False
    features = {site_view: array[keep] for site_view, array in run.features.items()}
    some = ArrayRun(run.path, "m", "s@1#0", run.episodes[keep].reset_index(drop=True), features)
    of = "side.correct" if target == "side.correct" else target_of(some, "continuous")
    results = train_probes(some, ("all",), target=of, incomplete="drop", **QUICK)
    assert results.left_out == {"episodes of items without their other layout": 3}
    assert (results.scores["n"] == len(run.episodes) - 6).all()


def test_a_side_and_a_label_transfer_by_the_same_call(tmp_path: Path, run: ArrayRun) -> None:
    other = ArrayRun(
        tmp_path / "other", "m", "s@1#1",
        run.episodes.assign(group_id="other-" + run.episodes["group_id"]), run.features,
    )  # fmt: skip
    label = transfer_probes(
        run,
        other,
        target_of(run, "continuous"),
        target_of(other, "continuous"),
        permutations=19,
        across_weights=True,
    )
    assert label.scores.set_index("layer").loc[1, "score"] > 0.5
    side = transfer_probes(run, other, "side.correct", permutations=19, across_weights=True)
    assert (side.task, side.classes, side.left_out) == ("binary", ("right", "left"), {})


def test_options_that_a_target_does_not_have_are_refused_with_the_reason(run: ArrayRun) -> None:
    label = target_of(run, "continuous")
    with pytest.raises(UsageError, match="a device solves logistic probes"):
        train_probes(run, target=label, device="cpu")
    with pytest.raises(UsageError, match=r"window=2 with the side 'side\.correct'; it needs labels of single"):
        train_probes(run, window=2)
    with pytest.raises(UsageError, match="a side is binary and its groups are the run's"):
        Target.of_run(run, "side.correct", group_by="layout")
    with pytest.raises(UnknownSiteError, match="store no directions"):
        train_probes(run, target=label, **QUICK).direction("all", "mean", SITES[0])


# -- a stored run ------------------------------------------------------------------------------------------------


@pytest.fixture
def stored(labelled_run: Path, tmp_path: Path) -> Run:
    shutil.copytree(labelled_run, tmp_path / "stored")
    return open_run(tmp_path / "stored")


@pytest.mark.slow
def test_a_label_of_whole_episodes_is_decoded_from_each_captured_inference(stored: Run) -> None:
    typed = ["train", str(stored.path), "--target", "item.category", "--call", "all", "--permutations", "0"]
    result = CliRunner().invoke(app, [*typed, "--controls", "none", "--task", "binary"], env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    for call in range(stored.captured_calls):
        assert f"call {call}" in result.stdout
    calls = sorted(probes.call for probes in inventory(stored).probes)
    assert calls == list(range(stored.captured_calls))
    assert load_results(stored, target="item.category").settings.target == "item.category"


def test_the_command_lists_every_target_with_its_values_or_the_reason_why_not(stored: Run) -> None:
    result = CliRunner().invoke(app, ["targets", str(stored.path)], env={"COLUMNS": "250"})
    assert result.exit_code == 0, result.output
    lines = {line.split()[0]: line for line in result.stdout.splitlines() if line.strip()}
    assert {"side.correct", "side.chosen", "sim.tool_y", "item.category"} <= set(lines)
    counts = stored.episodes["side_correct"].value_counts()
    assert f"2 classes: right {counts['right']}, left {counts['left']}" in lines["side.correct"]
    assert "continuous" in lines["sim.tool_y"]
    assert "numbers from" in lines["sim.tool_y"]
    listed = CliRunner().invoke(app, ["targets", str(stored.path), "--format", "json"])
    rows = {row["target"]: row for row in json.loads(listed.stdout)}
    side, quantity = rows["side.correct"], rows["sim.tool_y"]
    assert side["values"] == {"labels": len(stored.episodes), "missing": 0, "classes": counts.to_dict()}
    assert quantity["tasks"] == ["continuous"]
    assert quantity["values"]["minimum"] < quantity["values"]["maximum"]
    assert quantity["command"] == f"probe-kit train {stored.path} --target sim.tool_y"
    texts = [text for row in rows.values() for text in row.values() if isinstance(text, str)]
    assert all(text == text.strip() for text in texts)
    assert not any("classes:" in text or "numbers from" in text for text in texts)
    csv_rows = CliRunner().invoke(app, ["targets", str(stored.path), "--format", "csv"]).stdout
    assert '""labels""' in csv_rows, "a cell that is a table itself is JSON"
