"""`pk.probe`: probes of plain arrays, as users of scikit-learn expect them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.metrics import balanced_accuracy_score, r2_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

import probe_kit as pk
from probe_kit.errors import TooFewGroupsError, UnknownSiteError, UsageError
from probe_kit.hooks import Site, Stream
from probe_kit.train import ArrayRun

GROUPS = np.repeat(np.arange(24), 4)
Y = np.tile([0, 1, 1, 0], 24)
N, D = Y.size, 6


def noise(seed: int, *shape: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(size=shape)


@pytest.fixture(scope="module")
def planted() -> NDArray[np.float64]:
    """(3, N, D): the label lies in the second site."""
    features = noise(0, 3, N, D)
    features[1, :, 2] += 3 * Y
    return features


@pytest.fixture(scope="module")
def probed(planted: NDArray[np.float64]) -> Any:
    return pk.probe(
        planted, Y, GROUPS, controls={"words": noise(1, N, 3)}, untrained=noise(2, 3, N, D), permutations=40
    )


def test_the_site_that_holds_the_label_has_signal_and_the_others_have_none(probed: Any) -> None:
    assert probed.best == "1"
    assert probed.scores["signal"].tolist() == [False, True, False]
    best = probed.scores.loc["1"]
    assert best["ci_low"] <= best["score"] <= best["ci_high"]
    assert best["p_fwe"] == pytest.approx(1 / 41)
    assert best[["exceeds_words", "exceeds_untrained"]].all()
    assert abs(best["chance"] - 0.5) < 0.1
    assert probed.null.shape == (3, 40)
    assert "best 1 with balanced accuracy" in repr(probed)


def test_groups_are_held_out_as_a_whole(probed: Any) -> None:
    assert all(np.unique(probed.fold_of[group == GROUPS]).size == 1 for group in range(24))


def test_scores_and_predictions_are_those_of_scikit_learn_on_the_same_folds(
    planted: NDArray[np.float64], probed: Any
) -> None:
    """L2 logistic regression on standardised features, without the prior of the training fold."""
    penalties = [float(strength) for strength in probed.scores.loc["1", "penalties"].split()]
    predicted = np.empty(N, int)
    for fold, penalty in enumerate(penalties):
        test = probed.fold_of == fold
        model = make_pipeline(StandardScaler(), LogisticRegression(C=1 / penalty, tol=1e-10, max_iter=10_000))
        model.fit(planted[1][~test].astype(np.float32), Y[~test])
        share = Y[~test].mean()
        predicted[test] = model.decision_function(planted[1][test].astype(np.float32)) > np.log(
            share / (1 - share)
        )
    assert (probed.predictions[1] == predicted).all()
    assert probed.scores.loc["1", "score"] == pytest.approx(balanced_accuracy_score(Y, predicted), abs=0.01)


def test_quantities_have_the_r2_of_a_ridge_of_scikit_learn() -> None:
    features = noise(3, N, D)
    quantity = features[:, 0] + 0.1 * noise(4, N)
    result = pk.probe(features, quantity, GROUPS, permutations=0)
    assert result.scores["metric"].tolist() == ["R²"]
    assert result.scores.loc["0", "score"] == pytest.approx(r2_score(quantity, result.predictions[0]), abs=0.02)
    test = result.fold_of == 0
    plain = make_pipeline(StandardScaler(), Ridge(1e-3)).fit(features[~test], quantity[~test])
    assert np.corrcoef(plain.predict(features[test]), result.predictions[0][test])[0, 1] > 0.999


def test_one_site_names_and_classes_come_back_as_they_were_passed(planted: NDArray[np.float64]) -> None:
    texts = np.where(Y == 1, "yes", "no")
    result = pk.probe({"tower": planted[1], "words": planted[0][:, :2]}, texts, permutations=0)
    assert result.scores.index.tolist() == ["tower", "words"]
    assert set(result.predictions.ravel()) == {"yes", "no"}
    assert result.scores["p_fwe"].isna().all()
    assert result.scores.loc["tower", "groups"] == N
    alone = pk.probe(planted[1], Y, permutations=0)
    assert alone.predictions.dtype == Y.dtype
    assert alone.scores.index.tolist() == ["0"]


def test_the_order_of_samples_has_no_meaning_unless_it_is_said_to(planted: NDArray[np.float64]) -> None:
    """Of labels that are alike in every group no exchange in order changes anything."""
    free = pk.probe(planted[1], Y, GROUPS, permutations=20)
    assert free.scores.loc["0", "p_fwe"] == pytest.approx(1 / 21)
    with pytest.warns(UserWarning, match="the same in every group"):
        ordered = pk.probe(planted[1], Y, GROUPS, permutations=20, ordered=True)
    assert not ordered.scores.loc["0", "p_fwe"] < 0.05


@pytest.mark.parametrize("name", ["step", "state", "action", "instruction", "pixels"])
def test_a_control_that_is_called_like_a_built_in_one_is_the_array_that_was_passed(
    planted: NDArray[np.float64], name: str
) -> None:
    words = noise(1, N, 3) + 2 * Y[:, None]
    first_score, other = (
        pk.probe(planted[1], Y, GROUPS, controls={control_name: words}, permutations=0).results.controls.scores[0]
        for control_name in (name, "words")
    )
    assert first_score.score == other.score > 0.9


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"X": np.zeros(N)}, r"X has the shape \(96,\); expected \(N, D\)"),
        ({"X": {}}, "holds no site"),
        ({"X": {"a": np.zeros((N, 2)), "b": np.zeros((N - 1, 2))}}, r"site 'b' of X has the shape \(95, 2\)"),
        ({"X": np.full((N, 2), np.nan)}, "X holds NaN or infinity in row 0"),
        ({"X": np.full((N, 2), "a")}, "X holds no numbers"),
        ({"y": Y[:-1]}, r"y has the shape \(95,\); expected \(96,\)"),
        ({"y": np.where(Y == 1, np.nan, 1.5)}, "y has no value in row 1"),
        ({"y": np.arange(N) % 5}, "classes or quantities"),
        ({"groups": GROUPS[:3]}, "groups has the shape"),
        ({"controls": {"chance": np.zeros((N, 1))}}, "called 'chance'"),
        ({"controls": {"words": np.zeros((3, 1))}}, r"controls\['words'\] has the shape"),
        ({"untrained": noise(5, N - 1, D)}, "untrained has the shape"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_by_name(changed: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"X": noise(0, N, D), "y": Y, "groups": GROUPS}
    with pytest.raises(UsageError, match=message):
        pk.probe(**{**arguments, **changed}, permutations=0)


def test_fewer_than_five_groups_are_refused() -> None:
    with pytest.raises(TooFewGroupsError, match="4 groups"):
        pk.probe(noise(0, N, D), Y, GROUPS % 4, permutations=0)


PlantedRun = Callable[..., ArrayRun]


def test_streams_are_read_off_the_sites(planted_run: PlantedRun) -> None:
    assert planted_run().streams == {
        "backbone": Stream("backbone", 5, 20),
        "expert": Stream("expert", 2, 8, iterations=2),
    }


def test_other_features_are_another_run(planted_run: PlantedRun) -> None:
    assert planted_run().settings_sha256 == planted_run().settings_sha256
    assert planted_run().settings_sha256 != planted_run({Site("backbone", 0): 1.0}).settings_sha256


def test_a_row_per_episode_is_required(planted_run: PlantedRun, tmp_path: Path) -> None:
    features = {(Site("backbone", 0), "mean"): np.zeros((3, 4))}
    with pytest.raises(UsageError, match=r"expected \(80, D\)"):
        ArrayRun(tmp_path, "mine", "suite@1#0", planted_run().episodes, features)


def test_a_row_per_episode_is_required_of_controls_too(planted_run: PlantedRun, tmp_path: Path) -> None:
    controls = {"words": np.zeros((3, 4))}
    with pytest.raises(
        UsageError, match=r"features of the control 'words' have shape \(3, 4\); expected \(80, D\)"
    ):
        ArrayRun(tmp_path, "mine", "suite@1#0", planted_run().episodes, {}, control_features=controls)


def test_a_missing_site_is_an_error(planted_run: PlantedRun) -> None:
    with pytest.raises(UnknownSiteError, match=r"backbone\.09\.residual"):
        planted_run().column(Site("backbone", 9), "mean")
