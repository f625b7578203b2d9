import numpy as np

from probe_kit.train.permutation import exchange_items, family_p, flip_items, site_p

ITEMS = np.repeat(np.arange(200), 2)
LAYOUTS = np.tile(["original", "swapped"], 200)
LABELS = np.tile([True, False], 200)


def test_flipping_keeps_the_two_layouts_of_an_item_opposite() -> None:
    flipped = flip_items(LABELS, ITEMS, 50, seed=0)
    assert (flipped[0::2] != flipped[1::2]).all()
    assert 0.45 < (flipped != LABELS[:, None]).mean() < 0.55


def test_exchanging_keeps_the_class_share_of_each_layout() -> None:
    labels = np.random.default_rng(0).random(400) < np.where(LAYOUTS == "original", 0.9, 0.2)
    exchanged = exchange_items(labels, ITEMS, LAYOUTS, 50, seed=0)
    for layout in ("original", "swapped"):
        assert (exchanged[layout == LAYOUTS].mean(axis=0) == labels[layout == LAYOUTS].mean()).all()
    assert (exchanged != labels[:, None]).any(axis=0).all()


def test_items_with_one_episode_exchange_only_among_themselves() -> None:
    items, layouts = np.array([0, 0, 1, 1, 2, 3]), np.array(["original", "swapped"] * 2 + ["original"] * 2)
    labels = np.array([True, True, True, True, False, False])
    exchanged = exchange_items(labels, items, layouts, 20, seed=0)
    assert (exchanged == labels[:, None]).all()


def test_the_same_seed_gives_the_same_relabellings() -> None:
    assert (flip_items(LABELS, ITEMS, 5, seed=3) == flip_items(LABELS, ITEMS, 5, seed=3)).all()


def test_p_counts_the_real_labels_among_the_draws() -> None:
    null = np.array([[0.5, 0.6, 0.7], [0.4, 0.5, 0.5]])
    assert site_p(np.array([0.65, 0.9]), null).tolist() == [2 / 4, 1 / 4]


def test_family_wise_p_compares_with_the_best_site() -> None:
    null = np.array([[0.5, 0.6, 0.5], [0.4, 0.5, 0.7]])
    assert family_p(np.array([0.65, 0.55]), null).tolist() == [2 / 4, 3 / 4]


def test_p_is_missing_without_relabellings() -> None:
    assert np.isnan(site_p(np.array([0.9]), np.empty((1, 0)))).all()
    assert np.isnan(family_p(np.array([0.9]), np.empty((1, 0)))).all()
