"""`probe-kit train`: sides, labels of every task, controls, token views, later inferences."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import balanced_accuracy_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

import probe_kit as pk
from tests.acceptance.conftest import PLAYED
from tests.acceptance.product import probe_kit

SIDE_CONTROLS = {"position", "instruction", "pixels", "random-features"}
LABEL_CONTROLS = {"step", "state", "instruction"}
"""Those with pictures are tried on the small run of recordings, see `test_other_sources.py`."""


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first frames of the shared run, through another network of the same shape."""
    folder = tmp_path_factory.mktemp("untrained") / "run"
    few = [word for word in PLAYED if word != "all"]
    few = [word for word in few if word != "--tokens"]
    probe_kit("extract", *few[: few.index("--max-steps")], "--no-act", "--random-weights", "--out", folder)
    return folder


@pytest.fixture(scope="module")
def trained(played: Path, untrained: Path) -> Path:
    """The shared run with probes of the side, of both captured inferences, beside every control."""
    typed = ("train", played, "--permutations", "5", "--controls", ",".join(sorted(SIDE_CONTROLS)))
    text = probe_kit(*typed, "--untrained", untrained, "--call", "0").text
    assert "backbone" in text
    assert "accuracy" in text
    probe_kit(
        "train", played, "--permutations", "5", "--controls", "none", "--call", "1", "--views", "mean:language"
    )
    return played


@pytest.fixture(scope="module")
def sides(trained: Path) -> pd.DataFrame:
    """The scores of the newest probes, as users load them."""
    typed = ("--permutations", "5", "--controls", ",".join(sorted(SIDE_CONTROLS)))
    assert probe_kit("train", trained, *typed).out, "stored probes are read"
    scores: pd.DataFrame = pk.load_results(pk.open_run(trained)).scores
    return scores


@pytest.fixture(scope="module")
def table(played: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's own labels, per episode: a binary one, one of three classes, a quantity, noise."""
    file = tmp_path_factory.mktemp("labels") / "own.csv"
    probe_kit("labels", played, "--out", file.with_name("all.csv"))
    lines = pd.read_csv(file.with_name("all.csv"))
    assert {"episode_id", "inference", "sim.tool_y", "sim.held", "item.named", "item.left"} <= set(lines.columns)
    own = lines.groupby("episode_id", sort=False).agg(end_y=("sim.tool_y", "last")).reset_index()
    own["goes_left"] = own["end_y"] > 0
    own["kind"] = [("warm", "cold", "neutral")[row % 3] for row in range(len(own))]
    own.to_csv(file, index=False)
    return file


@pytest.mark.slow
def test_the_side_is_scored_at_every_site_with_its_interval_and_its_p(sides: pd.DataFrame, played: Path) -> None:
    run = pk.open_run(played)
    iterations = {name: stream.iterations or 1 for name, stream in run.streams.items()}
    assert len(sides) == sum(stream.layers * iterations[name] for name, stream in run.streams.items())
    assert set(sides["category"]) == {"color"}
    assert (sides[["n", "items", "groups"]] == [24, 12, 6]).all(axis=None)
    assert (sides["chance"] == 0.5).all()
    assert sides["accuracy"].between(0, 1).all()
    assert ((sides["ci_low"] <= sides["accuracy"]) & (sides["accuracy"] <= sides["ci_high"])).all()
    assert ((sides["smallest_p"] <= sides["p"]) & (sides["p"] <= sides["p_fwe"]) & (sides["p_fwe"] <= 1)).all()
    backbone = sides[sides["stream"] == "backbone"].set_index("layer")["accuracy"]
    assert backbone.loc[0] == 0.5, "both layouts of an item have the same embeddings on average"
    assert backbone.loc[3] > 0.85, "the embedded policy knows Color"


@pytest.mark.slow
def test_one_accuracy_is_that_of_scikit_learn_in_the_same_folds(sides: pd.DataFrame, played: Path) -> None:
    run = pk.open_run(played)
    curve = pk.load_results(run).curves["color", "mean"]
    for site in (pk.Site("backbone", 3), pk.Site("expert", 1, iteration=4)):
        row = sides.set_index("site").loc[str(site)]
        features = run.column(site, "mean").astype(np.float64)
        left = (run.episodes["side_correct"] == "left").to_numpy()
        answers = np.empty(len(left), dtype=bool)
        for fold, strength in enumerate(map(float, row["C"].split())):
            test = curve.fold_of == fold
            assert not set(curve.groups[test]) & set(curve.groups[~test])
            probe = LogisticRegression(C=strength, tol=1e-10, solver="newton-cholesky", max_iter=1000)
            oracle = make_pipeline(StandardScaler(), probe).fit(features[~test], left[~test])
            answers[test] = oracle.predict(features[test])
        assert row["accuracy"] == pytest.approx(balanced_accuracy_score(left, answers))


@pytest.mark.slow
def test_every_control_of_the_side_is_stored_and_the_untrained_network_is_compared(
    trained: Path, untrained: Path
) -> None:
    run = pk.open_run(trained)
    controls = pk.load_results(run).controls
    assert {score.name for score in controls.scores} == SIDE_CONTROLS
    assert all(0 <= score.score <= 1 for score in controls.scores)
    results = pk.train_probes(run, permutations=5, controls=("random-features",), untrained=pk.open_run(untrained))
    assert results.scores["exceeds_untrained"].isin([True, False]).all()
    assert results.scores["exceeds_random_features"].isin([True, False]).all()
    signal = results.scores[results.scores["signal"]]
    assert (signal["exceeds_untrained"] & signal["exceeds_random_features"] & (signal["p_fwe"] < 0.05)).all()


def test_a_later_inference_has_probes_of_its_own(played: Path) -> None:
    text = probe_kit(
        *("train", played, "--permutations", "5", "--controls", "none", "--call", "1", "--views", "mean:language")
    ).text
    assert "color" in text
    refused = probe_kit("train", played, "--call", "7", "--permutations", "5", code=2)
    assert "7" in refused.text


@pytest.mark.parametrize("target", ["side.chosen", "side.shuffled"])
def test_the_chosen_and_the_shuffled_side_are_targets_too(played: Path, target: str) -> None:
    run = pk.open_run(played)
    scores = pk.train_probes(run, target=target, permutations=3, controls=(), views=("mean:language",)).scores
    assert (scores["target"] == target).all()
    if target == "side.chosen":
        assert scores["accuracy"].max() > 0.85


def test_single_tokens_are_probed_in_a_token_view(played: Path) -> None:
    typed = ("--views", "tokens:language", "--token-permutations", "3", "--controls", "none")
    assert "tokens:language" in probe_kit("train", played, *typed).text
    scores = pk.load_results(pk.open_run(played)).scores
    assert set(scores["view"]) == {"tokens:language"}
    assert (scores["stream"] == "backbone").all()
    assert scores.set_index("layer")["accuracy"].loc[3] > 0.75


@pytest.mark.parametrize(
    ("target", "task", "metric", "top"),
    [
        ("goes_left", "binary", "accuracy", 0.9),
        ("kind", "classes", "accuracy", 0),
        ("end_y", "continuous", "R", 0.7),
    ],
)
def test_a_label_of_a_users_table_is_decoded_by_its_task(
    played: Path, table: Path, target: str, task: str, metric: str, top: float
) -> None:
    typed = ("--labels", table, "--target", target, "--permutations", "5", "--controls", "instruction")
    assert target in probe_kit("train", played, *typed).text
    run = pk.open_run(played)
    scores = pk.train_probes(
        run, target=pk.Target.read(table, target), permutations=5, controls=("instruction",)
    ).scores
    assert set(scores["task"]) == {task}
    assert scores["metric"].str.contains(metric).all()
    assert scores["score"].max() >= top
    assert scores["score"].max() <= 1
    assert ((scores["ci_low"] <= scores["score"]) & (scores["score"] <= scores["ci_high"])).all()
    if task != "continuous":
        assert scores["score"].min() >= 0


@pytest.mark.slow
def test_a_built_in_label_by_inference_is_decoded_beside_its_controls(played: Path) -> None:
    typed = ("--target", "sim.tool_y", "--permutations", "3", "--controls", ",".join(sorted(LABEL_CONTROLS)))
    text = probe_kit("train", played, *typed).text
    for control in LABEL_CONTROLS:
        assert control in text
    run = pk.open_run(played)
    results = pk.train_probes(
        run, target=pk.Target.of_run(run, "sim.tool_y"), permutations=3, controls=("step", "state")
    )
    best = results.scores["score"].max()
    assert best > 0.5
    assert best <= 1
    assert (results.scores["n"] == 48).all(), "two inferences of every episode"
    table = probe_kit("retention", played, "--target", "sim.tool_y").text
    assert "sim.tool_y" in table


@pytest.mark.parametrize(
    ("typed", "named"),
    [
        (("--target", "sim.tool_w"), "sim.tool_y"),
        (("--views", "mean:words"), "language"),
        (("--categories", "colour"), "color"),
        (("--controls", "luck"), "position"),
    ],
)
def test_a_wrong_name_is_refused_with_the_possible_ones(played: Path, typed: tuple[str, ...], named: str) -> None:
    assert named in probe_kit("train", played, *typed, code=2).text


def test_a_table_with_a_key_that_the_run_lacks_is_refused_by_its_line(
    played: Path, table: Path, tmp_path: Path
) -> None:
    lines = table.read_text(encoding="utf-8").splitlines()
    lines[3] = lines[3].replace(lines[3].split(",")[0], "no-such-episode")
    (tmp_path / "wrong.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    refused = probe_kit("train", played, "--labels", tmp_path / "wrong.csv", "--target", "end_y", code=None)
    assert refused.code in (1, 2, 3)
    assert "no-such-episode" in refused.text
    assert "4" in refused.text
