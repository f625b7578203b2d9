"""Results: scores and controls, directions, the best sites in words, and the inventory of a run."""

import json
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from probe_kit._tables.numbers import percent
from probe_kit.errors import RunDamagedError, UnknownSiteError
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.results import Bundle, read_bundle, write_bundle
from probe_kit.runs.store import locate
from probe_kit.train import (
    ArrayRun,
    Direction,
    ProbeCurve,
    ProbeResults,
    ProbeSettings,
    load_results,
    train_probes,
)
from probe_kit.train.results.control_scores import (
    ControlComparison,
    Controls,
    ControlScore,
    UntrainedScore,
    has_signal,
)
from probe_kit.train.results.inventory import inventory
from probe_kit.train.results.probe_results import (
    StoredDirections,
    best_sites,
    best_sites_table,
    save_directions,
    site_cells,
)
from probe_kit.train.results.summary import best_sites_findings
from tests.train.conftest import PlantedRun, plant

SETTINGS = ProbeSettings(
    "m", False, None, "s@1#0", "s@1#0", "0", "0", ("color",), ("mean",), "side.correct", permutations=9, seed=0
)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> ProbeResults:
    run = plant(tmp_path_factory.mktemp("run"), {Site("backbone", 3): 2.0}, categories=("color", "public-info"))
    return train_probes(run, permutations=39)


def test_scores_follow_from_the_stored_decisions(results: ProbeResults) -> None:
    for (category, view), curve in results.curves.items():
        rows = results.scores[(results.scores["category"] == category) & (results.scores["view"] == view)]
        assert rows["site"].tolist() == [str(site) for site in curve.sites]
        np.testing.assert_array_equal(rows["accuracy"], curve.correct.mean(axis=1))
        np.testing.assert_array_equal(rows["p_fwe"], curve.p_fwe())


def test_fold_accuracies_average_to_the_accuracy(results: ProbeResults) -> None:
    row, curve = results.scores.iloc[3], results.curves["color", "mean"]
    weights = [fold.test.size for fold in curve.folds()]
    per_fold = [float(value) for value in row["fold_accuracy"].split()]
    assert np.average(per_fold, weights=weights) == pytest.approx(row["accuracy"], abs=1e-4)


@pytest.mark.parametrize("name", [name for name in asdict(SETTINGS) if name != "random_weights"])
def test_any_other_setting_is_another_key(name: str) -> None:
    other = {"categories": ("shape",), "views": ("last",), "permutations": 10, "seed": 1, "format": 99}
    assert replace(SETTINGS, **{name: other.get(name, "other")}).key != SETTINGS.key  # type: ignore[arg-type]


@pytest.fixture
def curve(results: ProbeResults) -> ProbeCurve:
    return results.curves["color", "mean"]


def test_streams_are_families_of_their_own(curve: ProbeCurve) -> None:
    p, accuracy = curve.p_fwe(), curve.correct.mean(axis=1)
    for stream in ("backbone", "expert"):
        rows = curve.stream(stream)
        best = curve.null[rows].max(axis=0)
        expected = [(1 + (best >= accuracy[row]).sum()) / 40 for row in rows]
        np.testing.assert_allclose(p[rows], expected)


def test_folds_partition_the_episodes_and_keep_groups_whole(curve: ProbeCurve) -> None:
    tested = np.concatenate([fold.test for fold in curve.folds()])
    assert sorted(tested) == list(range(80))
    for fold in curve.folds():
        assert not set(curve.groups[fold.train]) & set(curve.groups[fold.test])


def test_correct_compares_the_sign_of_the_decision_with_the_label(curve: ProbeCurve) -> None:
    np.testing.assert_array_equal(curve.correct, (curve.decisions > 0) == curve.labels)
    assert curve.correct[3].mean() > 0.9


def test_depth_runs_from_the_first_to_the_last_layer(curve: ProbeCurve) -> None:
    assert [curve.depth(Site("backbone", layer)) for layer in (0, 2, 4)] == [0.0, 0.5, 1.0]
    assert curve.depth(Site("expert", 1, "residual", 0)) == 1.0


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
    for column_key, expected in places.items():
        for part, array in vars(expected).items():
            np.testing.assert_array_equal(getattr(stored[column_key], part), array)
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


def score_of(name: str, p: float | None = 0.5, score: float = 0.5) -> ControlScore:
    return ControlScore(name, "color", score, (0.4, 0.6), p, 0.5, 80)


def untrained(site: str, peak: bool) -> UntrainedScore:
    return UntrainedScore("color", "mean", site, site, peak, 0.9, 0.5, 0.4, (0.3, 0.5), "tiny (random weights)")


def test_above_chance_means_a_small_p() -> None:
    assert score_of("pixels", 0.01).above_chance
    assert not score_of("pixels", 0.05).above_chance
    assert not score_of("pixels", None).above_chance


def test_a_newer_score_replaces_an_older_one_and_keeps_the_untrained_network() -> None:
    controls = Controls((score_of("pixels"), score_of("position")), (untrained("backbone.01.residual", True),))
    merged = controls.with_scores([score_of("pixels", score=0.9)])
    assert {name: score.score for name, score in merged.of_category("color").items()} == {
        "pixels": 0.9,
        "position": 0.5,
    }
    assert merged.untrained == controls.untrained
    assert merged.of_category("shape") == {}


def test_the_untrained_network_of_a_stream_is_its_peak() -> None:
    scores = [
        untrained("backbone.01.residual", False),
        untrained("expert.00.residual@1", True),
        untrained("backbone.03.residual", True),
    ]
    controls = Controls().with_untrained(scores, "0123456789ab")
    assert controls.untrained_peak("color", "mean", "backbone") == scores[2]
    assert controls.untrained_peak("color", "last", "backbone") is None


def test_a_signal_must_exceed_every_control_that_was_run() -> None:
    site = "backbone.01.residual"
    controls = Controls().with_scores([], [ControlComparison("random-features", "color", "mean", site, 0.6, 0.2)])
    assert controls.exceeds("color", "mean", site, 0.001) == {
        "chance": True,
        "random-features": False,
        "untrained": None,
    }
    assert not has_signal(controls.exceeds("color", "mean", site, 0.001))
    better = controls.with_scores([], [ControlComparison("random-features", "color", "mean", site, 0.6, 0.01)])
    assert has_signal(better.exceeds("color", "mean", site, 0.001))
    assert not has_signal(better.exceeds("color", "mean", site, 0.2))
    assert better.exceeds("shape", "mean", site, 0.001) == {
        "chance": True,
        "random-features": None,
        "untrained": None,
    }
    assert has_signal({"chance": True, "random-features": None, "untrained": None})
    assert better.exceeds("color", "mean", site, float("nan"))["chance"] is None
    assert not has_signal(better.exceeds("color", "mean", site, float("nan")))


def test_json_gives_the_same_controls_back() -> None:
    excess = ControlComparison("untrained", "color", "mean", "backbone.01.residual", 0.6, 0.2)
    controls = Controls((score_of("pixels", None),), (untrained("backbone.01.residual", True),), (excess,))
    assert Controls.from_json(json.loads(json.dumps(controls.to_json()))) == controls


def with_pixels(results: ProbeResults, p: float) -> ProbeResults:
    scores = [
        ControlScore("pixels", category, 0.81, (0.7, 0.9), p, 0.5, 48) for category in results.settings.categories
    ]
    return replace(results, controls=results.controls.with_scores(scores))


@pytest.mark.parametrize(("p", "is_named"), [(0.01, True), (0.2, False)])
def test_pictures_that_decode_the_target_alone_are_named(results: ProbeResults, p: float, is_named: bool) -> None:
    lines = [line for line in best_sites_findings(with_pixels(results, p)) if "was not run" not in line]
    assert len(lines) == 2
    assert all(("the pictures alone decode it too" in line) == is_named for line in lines)


def test_the_last_lines_are_short_sentences_of_two_numbers_without_brackets(results: ProbeResults) -> None:
    findings = best_sites_findings(with_pixels(results, 0.01))
    lines = [line for line in findings if "was not run" not in line]
    assert [line[:13] for line in lines] == ["Color        ", "Public Info  "]
    assert lines[0].startswith("Color        decodable in the backbone at ")
    for line in lines:
        assert line.endswith("; the pictures alone decode it too.")
        assert len(line.split()) <= 25
        assert len(re.findall(r"\d+", line)) <= 2
        assert not re.search(r"[][()]", line)


SITES = {
    Site("backbone", 0): 0.5, Site("backbone", 1): 0.9, Site("backbone", 2): 0.9,
    Site("expert", 0, "residual", 0): 0.6, Site("expert", 1, "residual", 0): 0.5,
    Site("expert", 0, "residual", 1): 0.8, Site("expert", 1, "residual", 1): 0.7,
}  # fmt: skip


def curve_of(lower: float = 0.0) -> ProbeCurve:
    """Decisions about 40 episodes, of which each site has a share right."""
    labels = np.tile([True, False], 20)
    right = np.stack([np.arange(40) < round(40 * (share - lower)) for share in SITES.values()])
    names = np.array([f"g{number // 4}" for number in range(40)])
    return ProbeCurve(
        sites=tuple(SITES), labels=labels, episodes=np.arange(40).astype(str), items=names, groups=names,
        fold_of=np.arange(40) // 4 % 5, decisions=np.where(right == labels, 1.0, -1.0),
        strengths=np.ones((len(SITES), 5)), null=np.full((len(SITES), 9), 0.5),
        inner=np.zeros((len(SITES), 5, 10), np.float32),
    )  # fmt: skip


@pytest.fixture
def results_of() -> ProbeResults:
    settings = ProbeSettings(
        "m", False, None, "s@1#0", "s@1#0", "0", "0", ("color",), ("mean",), "side.correct", permutations=9, seed=0
    )
    return ProbeResults(settings, {("color", "mean"): curve_of()})


def test_the_first_of_the_best_is_named_with_its_ties_and_the_first_iteration(results_of: ProbeResults) -> None:
    backbone, expert = best_sites(results_of.scores)
    assert site_cells(backbone, percent)[0].text == "backbone.01.residual +1"
    assert site_cells(backbone, percent)[1].text.startswith("90.0 [")
    assert [cell.text for cell in site_cells(backbone, percent)[2:]] == ["50.0", "0.100"]
    assert site_cells(expert, percent)[0].text == "expert.00.residual@1"
    assert expert["first"] == pytest.approx(0.6)
    assert backbone["first"] != backbone["first"], "the stream runs once"


def test_categories_do_not_mix(results_of: ProbeResults) -> None:
    both = replace(
        results_of,
        settings=replace(results_of.settings, categories=("shape", "color")),
        curves={("shape", "mean"): curve_of(0.2), **results_of.curves},
    )
    rows = best_sites(both.scores)
    assert [row["category"] for row in rows] == ["color", "color", "shape", "shape"]
    assert [round(row["score"], 2) for row in rows] == [0.9, 0.8, 0.7, 0.6]
    assert [row["ties"] for row in rows] == [1, 0, 1, 0]
    assert [row[0] for row in best_sites_table([both]).texts] == ["color", "color", "shape", "shape"]


@pytest.mark.parametrize(
    ("permutations", "sentence"),
    [
        (9, "not testable in the backbone and the action expert: train with --permutations 20 or more"),
        (200, "not testable in the backbone and the action expert: extract more items"),
    ],
)
def test_a_p_that_cannot_be_small_names_too_few_permutations_or_groups(
    results_of: ProbeResults, permutations: int, sentence: str
) -> None:
    """The null of these probes has nine columns: of as many as were asked for, or of all that the groups allow."""
    stored = replace(results_of, settings=replace(results_of.settings, permutations=permutations))
    assert best_sites_findings(stored) == [f"Color  {sentence}."]


@pytest.mark.slow
def test_a_run_lists_its_probes_oldest_first_and_which_are_used(planted_run: PlantedRun) -> None:
    run = planted_run({Site("backbone", 1): 1.0})
    assert inventory(run).probes == ()
    first = train_probes(run, permutations=1, controls=("position",))
    second = train_probes(run, permutations=2, target="side.shuffled", seed=7)
    listing = inventory(run)
    assert [(probes.key, probes.state) for probes in listing.probes] == [
        (first.key, "used"),
        (second.key, "other"),
    ]
    assert [(probes.target, probes.seed, probes.controls) for probes in listing.probes] == [
        ("side.correct", 0, ("position",)),
        ("side.shuffled", 7, ()),
    ]
    assert (listing.episodes, listing.planned, sum(listing.outcomes.values())) == (80, 80, 80)
    assert listing.streams["expert"] == "2 layers × 2 iterations, width 8; views mean"


def test_probes_of_other_episodes_are_named(planted_run: PlantedRun) -> None:
    run = planted_run()
    train_probes(run, permutations=0)
    shorter = {pair: array[:60] for pair, array in run.features.items()}
    fewer = ArrayRun(run.path, run.model, run.suite, run.episodes[:60], shorter)
    assert [probes.state for probes in inventory(fewer).probes] == ["other episodes"]
