"""Ridge regression against scikit-learn."""

import numpy as np
import pytest
from sklearn.linear_model import Ridge
from sklearn.preprocessing import StandardScaler

from probe_kit.train.solver.ridge import PENALTIES, RidgeFold


@pytest.mark.parametrize("shape", [(60, 12), (30, 80), (40, 40)], ids=str)
@pytest.mark.parametrize("kind", ["plain", "collinear", "constant feature", "offset"])
def test_predictions_at_every_penalty_are_those_of_scikit_learn(shape: tuple[int, int], kind: str) -> None:
    draw = np.random.default_rng(3)
    train, test = draw.normal(size=shape), draw.normal(size=(17, shape[1]))
    if kind == "collinear":
        train[:, 1], test[:, 1] = 2 * train[:, 0], 2 * test[:, 0]
    if kind == "constant feature":
        train[:, 2] = test[:, 2] = 4.0
    if kind == "offset":
        train, test = train + 1000, test + 1000
    targets = draw.normal(size=(shape[0], 3))
    found = list(RidgeFold.fit(train, test).predictions(targets))
    scaler = StandardScaler().fit(train)
    for penalty, predicted in zip(PENALTIES, found, strict=True):
        if np.isinf(penalty):
            expected = np.repeat(targets.mean(axis=0)[None, :], 17, axis=0)
        else:
            ridge = Ridge(alpha=penalty, solver="svd").fit(scaler.transform(train), targets)
            expected = ridge.predict(scaler.transform(test))
        np.testing.assert_allclose(predicted, expected, atol=1e-10, rtol=1e-10)


def test_features_that_never_vary_predict_the_mean() -> None:
    found = list(RidgeFold.fit(np.ones((6, 2)), np.ones((2, 2))).predictions(np.arange(6.0)[:, None]))
    assert all((predicted == 2.5).all() for predicted in found)
