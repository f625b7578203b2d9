"""Ridge regression for many targets and penalties from one factorisation of the training samples.

For standardised training samples Z, test samples T and centred targets Y the predictions at penalty λ are

    T Zᵀ (Z Zᵀ + λ)⁻¹ Y = T (Zᵀ Z + λ)⁻¹ Zᵀ Y

(Hoerl and Kennard, Technometrics 12, 1970), plus the mean of the targets. The smaller of both products is
factorised once, so that every relabelling is a matrix product.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.train.solver.standardiser import Standardiser

Matrix = NDArray[np.float64]

PENALTIES: Matrix = np.array([*10.0 ** np.arange(-2, 6), np.inf])
"""λ of the grid; at infinity the prediction is the mean of the training labels."""


@dataclass(frozen=True)
class RidgeFold:
    """Training and test samples of one fold, factorised.

    spectrum: (R,) eigenvalues. to_coordinates: (R, n) turns centred training targets into coordinates.
    to_predictions: (m, R) turns shrunken coordinates into predictions of the test samples.
    """

    spectrum: Matrix
    to_coordinates: Matrix
    to_predictions: Matrix

    @classmethod
    def fit(cls, train: NDArray[np.floating], test: NDArray[np.floating]) -> "RidgeFold":
        """Factorise (n, D) training samples for (m, D) test samples. Features are standardised by the former."""
        from scipy.linalg import eigh  # type: ignore[import-untyped]

        standardise = Standardiser.fit(train)
        z, t = standardise(train), standardise(test)
        if z.shape[1] == 0:  # nothing varies: the prediction is the mean
            return cls(np.zeros(0), np.zeros((0, len(z))), np.zeros((len(t), 0)))
        if len(z) <= z.shape[1]:
            spectrum, axes = eigh(z @ z.T)
            return cls(spectrum.clip(0.0), axes.T, (t @ z.T) @ axes)  # rounding can make eigenvalues negative
        spectrum, axes = eigh(z.T @ z)
        return cls(spectrum.clip(0.0), axes.T @ z.T, t @ axes)

    def predictions(self, targets: Matrix, penalties: Matrix = PENALTIES) -> Iterator[Matrix]:
        """(m, K) predictions of the test samples at each penalty, from (n, K) training targets."""
        mean = targets.mean(axis=0)
        coordinates = self.to_coordinates @ (targets - mean)
        for penalty in penalties:
            if np.isinf(penalty):
                yield np.repeat(mean[None, :], len(self.to_predictions), axis=0)
            else:
                yield mean + self.to_predictions @ (coordinates / (self.spectrum + penalty)[:, None])
