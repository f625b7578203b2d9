from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from probe_kit.errors import RunDamagedError, UnknownSiteError
from probe_kit.hooks import Site
from probe_kit.runs.results import Bundle, read_bundle, write_bundle
from probe_kit.runs.store import locate
from probe_kit.train import ArrayRun, Direction, load_results, train_probes
from probe_kit.train.results.probe_directions import StoredDirections, save_directions

SITE = Site("backbone", 3)
KEY = "0123456789ab"


def direction(scale: float = 1.0) -> Direction:
    weights = scale * np.array([[3.0, 0.0], [0.0, 1.0]], np.float32)
    return Direction(weights, np.array([0.5, -0.5]), np.array([2.0, 4.0]))


def bundle(folder: Path, places: dict[tuple[str, str, Site], Direction]) -> Bundle:
    file = BytesIO()
    save_directions(places, file)
    write_bundle(locate(folder), "probes", KEY, {"settings": {}}, {"directions.npz": file.getvalue()})
    return read_bundle(locate(folder), "probes", KEY)


def test_every_fold_counts_alike_in_the_unit_direction() -> None:
    np.testing.assert_allclose(direction().unit, [np.sqrt(0.5), np.sqrt(0.5)])
    assert direction(0.0).unit.tolist() == [0.0, 0.0]
    assert direction().spread == 3.0


def test_stored_directions_are_read_back_one_by_one(tmp_path: Path) -> None:
    places = {("color", "mean:image.front", SITE): direction(), ("shape", "mean", SITE): direction(2.0)}
    stored = StoredDirections(bundle(tmp_path, places), "directions.npz")
    assert list(stored) == list(places)
    for place, expected in places.items():
        for part, array in vars(expected).items():
            np.testing.assert_array_equal(getattr(stored[place], part), array)
    assert ("color", "mean", SITE) not in stored


def test_directions_that_were_changed_are_no_directions(tmp_path: Path) -> None:
    stored = StoredDirections(bundle(tmp_path, {("color", "mean", SITE): direction()}), "directions.npz")
    file = tmp_path / "probes" / KEY / "directions.npz"
    file.write_bytes(file.read_bytes().replace(np.float32(3).tobytes(), np.float32(4).tobytes()))
    with pytest.raises(RunDamagedError, match=r"directions\.npz has other bytes"):
        list(stored)


def test_the_direction_of_a_planted_site_is_the_planted_feature(planted_run: Callable[..., ArrayRun]) -> None:
    run = planted_run({SITE: 3.0})
    train_probes(run, permutations=0)
    results = load_results(run)
    unit = results.direction("color", "mean", SITE).unit
    assert np.argmax(np.abs(unit)) == 3
    assert unit[3] > 0.7  # towards left, which was planted as positive
    curve = results.curves["color", "mean"]
    folds = results.direction("color", "mean", SITE)
    rows = np.arange(80)
    decisions = (run.column(SITE, "mean") * folds.weights[curve.fold_of]).sum(axis=1) + folds.intercepts[
        curve.fold_of
    ]
    np.testing.assert_allclose(decisions, curve.decisions[3, rows], atol=1e-5)


def test_a_site_without_probe_has_no_direction(planted_run: Callable[..., ArrayRun]) -> None:
    results = train_probes(planted_run(), permutations=0)
    with pytest.raises(UnknownSiteError, match=r"backbone\.09\.residual.*categories color in views mean"):
        results.direction("color", "mean", Site("backbone", 9))
