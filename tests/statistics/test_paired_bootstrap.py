import numpy as np

from probe_kit.statistics.paired_bootstrap import DRAWS, better_than_best, better_than_reference

GROUPS = np.repeat(np.arange(40), 4)


def right(share: float, sites: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((sites, GROUPS.size)) < share


def test_a_site_that_is_much_better_than_the_reference_gets_the_smallest_p() -> None:
    sites = np.concatenate([right(0.9, 1, 0), right(0.6, 3, 1)])
    p = better_than_reference(sites, right(0.6, 1, 2)[0].astype(float), GROUPS, seed=0)
    assert p[0] == 1 / (1 + DRAWS)
    assert (p[1:] > 0.05).all()


def test_the_best_of_many_equal_sites_is_rarely_better_than_the_reference() -> None:
    alarms = [
        better_than_reference(right(0.6, 20, seed), np.full(GROUPS.size, 0.6), GROUPS, seed).min() < 0.05
        for seed in range(100)
    ]
    assert np.mean(alarms) <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 100)


def test_the_best_of_many_sites_is_rarely_better_than_the_best_of_as_many_others() -> None:
    alarms = [
        better_than_best(right(0.6, 20, 2 * seed), right(0.6, 20, 2 * seed + 1), GROUPS, seed).min() < 0.05
        for seed in range(100)
    ]
    assert np.mean(alarms) <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 100)


def test_a_signal_in_one_site_is_better_than_the_best_of_the_twin() -> None:
    here = np.concatenate([right(0.6, 4, 0), right(0.9, 1, 1)])
    p = better_than_best(here, right(0.6, 7, 2), GROUPS, seed=0)
    assert p[4] < 0.01
    assert (p[:4] > 0.05).all()


def test_a_model_is_not_better_than_itself() -> None:
    sites = right(0.7, 5, 0)
    assert (better_than_best(sites, sites, GROUPS, seed=0) > 0.3).all()
