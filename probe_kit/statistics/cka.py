"""Likeness of two sets of features of the same episodes: centred kernel alignment with the unbiased estimator.

Song, Smola, Gretton, Bedo and Borgwardt, “Feature selection via dependence maximization”, JMLR 13 (2012);
Nguyen, Raghu and Kornblith, “Do wide and deep networks learn the same things?”, ICLR 2021.
"""

from math import sqrt

import numpy as np

from probe_kit._system.types import Matrix
from probe_kit.errors import UsageError

FEWEST = 4
"""Number of episodes that the unbiased estimator needs."""


def unbiased_cka(first: Matrix, second: Matrix) -> float:
    """Return the linear CKA of features (E, D) and (E, D') of the same episodes.

    It is 1 for features that are equal up to rotation and scaling. It is 0 on average where they are independent,
    whatever D. It is NaN where one set does not vary.

    HSIC = (tr KL + 1ᵀK1 · 1ᵀL1 / ((E − 1)(E − 2)) − 2 · 1ᵀKL1 / (E − 2)) / (E (E − 3)). K and L are the products
    of the features, with 0 on the diagonal.

    Raises:
        UsageError: For fewer than FEWEST episodes, or different numbers of episodes.
    """
    count = len(first)
    if count != len(second) or count < FEWEST:
        raise UsageError(
            f"features of {count} and {len(second)} episodes; expected those of the same {FEWEST} or more episodes"
        )
    products, other_products = (_products(features) for features in (first, second))
    spread = _hsic(products, products) * _hsic(other_products, other_products)
    return _hsic(products, other_products) / sqrt(spread) if spread > 0 else float("nan")


def _products(features: Matrix) -> Matrix:
    """Return the (E, E) inner products of centred features, scaled to the order of 1; the diagonal is 0."""
    centred = np.asarray(features, np.float64) - features.mean(axis=0, dtype=np.float64)
    scale = np.sqrt((centred**2).sum(axis=1).mean())
    products: Matrix = (centred / (scale or 1.0)) @ (centred / (scale or 1.0)).T
    np.fill_diagonal(products, 0.0)
    return products


def _hsic(first: Matrix, second: Matrix) -> float:
    count = len(first)
    rows, columns = first.sum(axis=0), second.sum(axis=0)
    total = float((first * second).sum())
    total += float(rows.sum() * columns.sum()) / ((count - 1) * (count - 2))
    total -= 2 * float(rows @ columns) / (count - 2)
    return total / (count * (count - 3))
