"""Controls: features without a model, random layers, and an untrained network."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from sklearn.metrics import accuracy_score
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks import Site, Stream
from probe_kit.runs import Run, open_run
from probe_kit.suite import Suite, build_suite, load_picture
from probe_kit.train import ArrayRun, ProbeResults, Target, load_results, train_probes
from probe_kit.train.control_features import ControlInputs, random_layer
from probe_kit.train.controls import is_informative
from probe_kit.train.results.inventory import inventory
from probe_kit.train.samples import Samples
from probe_kit.train.target_samples import TargetSamples
from tests.support.labelled_run import write_labelled_run
from tests.support.recorded_run import write_recorded_run
from tests.train.conftest import problem_of


def features_of(run: ArrayRun, name: str, drawn_suite: Suite | None) -> np.ndarray:
    """Features of a control of a side, for every episode."""
    rows = np.arange(len(run.episodes))
    names = np.full(rows.size, "all")
    samples = TargetSamples(rows, np.zeros_like(rows), np.zeros(rows.size), names, names, 1, {})
    return ControlInputs(run, samples, True, drawn_suite).features(name)


@pytest.fixture(scope="module")
def drawn_suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suites") / "suite", ("color",), 8)


def run_with(drawn_suite: Suite, path: Path) -> ArrayRun:
    episodes = pd.DataFrame(
        [
            {"episode_id": e.episode_id, "item_id": e.item.item_id, "layout": e.layout, "instruction": text}
            for e in drawn_suite.episodes()
            for text in [e.item.instruction]
        ]
    )
    return ArrayRun(path, "m", drawn_suite.identity, episodes, {})


def test_pixels_are_the_left_and_the_right_picture_of_the_layout(drawn_suite: Suite, tmp_path: Path) -> None:
    features = features_of(run_with(drawn_suite, tmp_path), "pixels", drawn_suite)
    left, right = features[:, :3072], features[:, 3072:]
    np.testing.assert_array_equal(left[0::2], right[1::2])  # swapping the layout swaps the pictures
    small = load_picture(drawn_suite.items[0].picture("left")).resize((32, 32), Image.Resampling.BOX)
    np.testing.assert_allclose(left[0].reshape(32, 32, 3) * 255, np.asarray(small), atol=1e-3)


def test_words_are_counted_alone_and_with_the_sign_of_the_layout(planted_run: Callable[..., ArrayRun]) -> None:
    run = planted_run()
    features = features_of(run, "instruction", None)
    alone, signed = np.split(features, 2, axis=1)
    words = sorted({word for text in run.episodes["instruction"] for word in text.split()})
    assert alone[:, words.index("cube")].tolist() == [1] * 80
    assert (alone.sum(axis=1) == 6).all()
    np.testing.assert_array_equal(signed, alone * np.tile([[1], [-1]], (40, 1)))


def test_a_control_that_does_not_exist_or_is_not_possible_is_refused(
    planted_run: Callable[..., ArrayRun],
) -> None:
    run = planted_run()
    with pytest.raises(UsageError, match="unknown control 'sound'; expected some of position, step, state"):
        train_probes(run, controls=("sound",))
    for name, reason in (("step", "one inference"), ("state", "no trajectories"), ("action", "no actions")):
        with pytest.raises(UsageError, match=f"control '{name}' is not possible: .*{reason}"):
            train_probes(run, controls=(name,))
    silent = ArrayRun(run.path, "m", "s@1#0", run.episodes.drop(columns="instruction"), run.features)
    with pytest.raises(UsageError, match="no column 'instruction'"):
        train_probes(silent, controls=("instruction",))


PlantedRun = Callable[..., ArrayRun]
PLANTED = Site("backbone", 3)


def renamed_run(run: ArrayRun, model: str, **changes: object) -> ArrayRun:
    """A copy in a folder of its own."""
    members = {**vars(run), "path": run.path.parent / model, "model": model, **changes}
    fields = ArrayRun.__annotations__
    return ArrayRun(**{name: value for name, value in members.items() if name in fields})


@pytest.mark.slow
def test_baselines_of_a_fair_suite_are_at_chance_and_stored(planted_run: PlantedRun) -> None:
    run = planted_run({PLANTED: 2.0})
    train_probes(run, permutations=40, controls=("position", "instruction"))
    baselines = load_results(run).controls.of_category("color")
    assert set(baselines) == {"position", "instruction"}
    for score in baselines.values():
        assert not score.above_chance
        assert score.ci[0] <= score.score <= score.ci[1]
        assert (score.n, score.chance) == (80, 0.5)


@pytest.mark.slow
def test_a_suite_that_keeps_the_answer_on_one_side_is_found_out(planted_run: PlantedRun) -> None:
    run = planted_run()
    run.episodes["side_correct"] = run.episodes["layout"].map({"original": "left", "swapped": "right"})
    controls = train_probes(run, permutations=40, controls=("position",)).controls
    score = controls.of_category("color")["position"]
    assert score.score == 1.0
    assert score.above_chance
    assert controls.exceeded("color", "mean", PLANTED) == {"position": False}, "a control that knows is asked"


@pytest.mark.parametrize(("gain", "informative"), [(0.0, False), (0.02, False), (0.3, True)])
@pytest.mark.parametrize("missing", [0, 20])
def test_a_control_is_asked_if_its_inner_folds_know_more_than_the_shares_of_the_sides(
    gain: float, informative: bool, missing: int
) -> None:
    labels, groups = np.tile([True, False], 40)[missing:], np.repeat(np.arange(20), 4)[missing:]
    labels[: missing // 2] = True
    share, names = labels.mean(), np.unique(groups)
    chance = share * np.log(share) + (1 - share) * np.log(1 - share)
    noise = np.random.default_rng(0).normal(0, 0.1, names.size)
    noise -= noise.mean()
    inner = np.tile((chance + gain + noise) * 4, (5, 1))
    inner[names % 5, np.arange(names.size)] = 0  # the outer fold's own groups
    assert is_informative(inner, labels, groups) == informative


@pytest.mark.slow
def test_controls_are_added_to_stored_probes_without_fitting_those_again(planted_run: PlantedRun) -> None:
    run = planted_run()
    first = train_probes(run, permutations=5, controls=("position",))
    again = train_probes(run, permutations=5, controls=("position", "instruction"))
    assert again.created == first.created
    assert again.controls.of_category("color")["position"] == first.controls.of_category("color")["position"]
    assert "instruction" in again.controls.of_category("color")


@pytest.mark.slow
def test_the_untrained_network_is_subtracted_per_site_and_per_peak(planted_run: PlantedRun) -> None:
    trained, untrained = planted_run({PLANTED: 2.0}), renamed_run(planted_run(), "random", random_weights=True)
    results = train_probes(trained, permutations=5, untrained=untrained)
    accuracy = results.curves["color", "mean"].correct.mean(axis=1)
    untrained_scores = load_results(untrained).curves["color", "mean"].correct.mean(axis=1)
    sites = [score for score in results.controls.untrained if not score.peak]
    np.testing.assert_allclose([score.difference for score in sites], accuracy - untrained_scores, atol=1e-12)
    assert sites[3].ci[0] > 0.2
    assert sites[3].ci[0] < sites[3].difference < sites[3].ci[1] < accuracy[3]
    assert sites[2].difference == 0.0, "the same features in both runs"
    unseen = 1 - 0.025 ** (1 / 20)
    assert 0.5 * unseen < sites[2].ci[1] < unseen, "20 groups that agree are no certainty"
    assert sites[2].ci[0] == pytest.approx(-sites[2].ci[1], abs=0.03)
    peak = results.controls.untrained_peak("color", "mean", "backbone")
    assert peak is not None
    assert (peak.site, peak.untrained) == (str(PLANTED), "random (random weights)")
    assert peak.difference == pytest.approx(accuracy.max() - untrained_scores[:5].max())


def test_an_untrained_network_of_other_episodes_is_refused(planted_run: PlantedRun) -> None:
    run = planted_run()
    episodes = run.episodes.assign(episode_id="other-" + run.episodes["episode_id"])
    with pytest.raises(UsageError, match="not the same"):
        train_probes(run, permutations=0, untrained=renamed_run(run, "random", episodes=episodes))


def test_an_untrained_network_of_other_episodes_costs_no_work(planted_run: PlantedRun) -> None:
    run = planted_run()
    episodes = run.episodes.assign(episode_id="other-" + run.episodes["episode_id"])
    progress_counts: list[int] = []
    with pytest.raises(UsageError, match="not the same"):
        train_probes(
            run,
            permutations=0,
            untrained=renamed_run(run, "random", episodes=episodes),
            progress=lambda *at: progress_counts.append(at[0]),
        )
    assert not progress_counts


def test_a_run_is_not_its_own_untrained_control(planted_run: PlantedRun) -> None:
    run = planted_run()
    with pytest.raises(UsageError, match="its own untrained control"):
        train_probes(run, permutations=0, untrained=run)


@pytest.mark.slow
def test_the_probes_of_an_untrained_network_are_read_only_where_no_others_were_asked_for(
    planted_run: PlantedRun,
) -> None:
    run, control = planted_run({PLANTED: 2.0}), renamed_run(planted_run(), "random", random_weights=True)
    fitted = train_probes(control, permutations=3)
    with_untrained = train_probes(run, permutations=2, untrained=control)
    assert load_results(control).key == fitted.key
    assert with_untrained.settings.permutations == 2
    assert {probes.state for probes in inventory(control).probes} == {"used", "other"}
    other = renamed_run(planted_run(), "other random", random_weights=True)
    train_probes(run, permutations=2, untrained=other)
    assert load_results(other).settings.permutations == 2


@pytest.mark.slow
def test_controls_name_the_untrained_network_even_where_two_networks_are_equally_accurate(
    planted_run: PlantedRun,
) -> None:
    run = planted_run({PLANTED: 2.0})
    networks = [
        renamed_run(planted_run(), name, random_weights=True) for name in ("first random", "second random")
    ]
    controls = [train_probes(run, permutations=0, untrained=network).controls for network in networks]
    accuracies = [[score.untrained_accuracy for score in of_network.untrained] for of_network in controls]
    assert accuracies[0] == accuracies[1]
    keys = [load_results(network).key for network in networks]
    assert [of_network.untrained_probes for of_network in controls] == keys
    assert keys[0] != keys[1]
    assert load_results(run).controls.untrained_probes == keys[1]


FAILURES = {
    "a control that needs a suite": {"controls": ("pixels",)},
    "an unknown control": {"controls": ("position", "smell")},
    "an unknown view": {"views": ("mean", "median")},
    "no view": {"views": ()},
    "a view twice": {"views": ("mean", "mean")},
    "an unknown category": {"categories": ("smell",)},
    "an unknown target": {"target": "wished"},
    "no process": {"jobs": 0},
    "negative label permutations": {"permutations": -1},
}


@pytest.mark.slow
@pytest.mark.parametrize("options", FAILURES.values(), ids=FAILURES)
def test_train_refuses_bad_controls_before_any_work_and_keeps_stored_results(
    planted_run: PlantedRun, options: dict[str, object]
) -> None:
    run = planted_run(n_items=12)
    before = train_probes(run, permutations=1, views=("mean",))
    files = sorted(run.path.rglob("*"))
    progress_counts: list[int] = []
    settings: dict[str, object] = {"permutations": 2, **options}
    with pytest.raises(UsageError):
        train_probes(run, **settings, progress=lambda *at: progress_counts.append(at[0]))  # type: ignore[arg-type]
    assert not progress_counts
    assert load_results(run).key == before.key
    assert sorted(run.path.rglob("*")) == files


@pytest.mark.slow
def test_a_sweep_that_fails_late_leaves_finished_sites_and_no_probes(
    planted_run: PlantedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a full disk would: the sites are there, the controls fail."""
    run = planted_run()
    before = train_probes(run, permutations=1)

    def fail(*_: object) -> None:
        raise OSError("no space")

    with monkeypatch.context() as patch:
        patch.setattr("probe_kit.train.probe_sweep.add_controls", fail)
        with pytest.raises(OSError, match="no space"):
            train_probes(run, permutations=2, controls=("position",))
    assert load_results(run).key == before.key
    (unfinished,) = inventory(run).unfinished.items()
    fitted: list[int] = []
    after = train_probes(run, permutations=2, controls=("position",), progress=lambda *at: fitted.append(at[0]))
    assert (not fitted, unfinished) == (True, (after.key, 9))
    assert load_results(run).key == after.key
    assert not inventory(run).unfinished


ITEMS, WIDTH = 100, 24


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suites") / "suite", ("color",), ITEMS)


def inputs_of(run: ArrayRun, suite: Suite) -> ControlInputs:
    rows = np.arange(len(run.episodes))
    names = np.full(rows.size, "all")
    return ControlInputs(run, TargetSamples(rows, 0 * rows, np.zeros(rows.size), names, names, 1, {}), True, suite)


def run_of(suite: Suite, path: Path, knowledge: float = 0.0) -> ArrayRun:
    """A network of three random layers on pictures and words; the last one may know the answer."""
    episodes = pd.DataFrame(
        {
            "episode_id": e.episode_id, "item_id": e.item.item_id, "layout": e.layout, "category": "color",
            "group_id": e.item.group_id, "side_correct": e.side_correct, "side_placed": "none", "outcome": "oob",
            "instruction": e.item.instruction,
        }
        for e in suite.episodes()
    )  # fmt: skip
    sites = list(Stream("backbone", 3, WIDTH).sites())
    run = ArrayRun(path, "random", suite.identity, episodes, {})
    inputs = inputs_of(run, suite)
    rows = np.arange(len(episodes))
    features = {(site, "mean"): inputs.layer(rows, WIDTH, 100 + site.layer) for site in sites}
    sign = np.where(episodes["side_correct"] == "left", 1.0, -1.0)
    features[sites[-1], "mean"][:, 0] += knowledge * sign.astype(np.float32)
    return ArrayRun(path, "random", suite.identity, episodes, features)


def probed(suite: Suite, path: Path, knowledge: float = 0.0) -> ProbeResults:
    run = run_of(suite, path, knowledge)
    return train_probes(run, permutations=39, controls=("random-features",), suite=suite.folder)


@pytest.mark.slow
def test_a_random_network_does_not_exceed_random_features(suite: Suite, tmp_path: Path) -> None:
    scores = probed(suite, tmp_path / "random").scores
    assert not scores["exceeds_random_features"].any()
    assert not scores["signal"].any()
    assert scores["exceeds_untrained"].isna().all()


def test_a_network_that_knows_the_answer_exceeds_random_features(suite: Suite, tmp_path: Path) -> None:
    results = probed(suite, tmp_path / "knowing", knowledge=1.5)
    best = results.scores.loc[results.scores["accuracy"].idxmax()]
    assert best["exceeds_random_features"]
    assert best["signal"]
    control = results.controls.of_category("color")["random-features"]
    assert control.ci[0] < control.score < control.ci[1]
    assert not control.above_chance  # what it has for free is no leak


def test_a_part_that_never_varies_gives_a_random_layer_nothing() -> None:
    """The state at the first frame of every recording is often one."""
    words = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    constant = np.ones((6, 2), np.float32)
    np.testing.assert_array_equal(random_layer([words, constant], 5, 0), random_layer([words], 5, 0))
    assert not random_layer([constant], 5, 0).any()


def test_random_layers_repeat_and_differ_by_seed(suite: Suite, tmp_path: Path) -> None:
    inputs, rows = inputs_of(run_of(suite, tmp_path), suite), np.arange(20)
    np.testing.assert_array_equal(inputs.layer(rows, 8, 0), inputs.layer(rows, 8, 0))
    assert (inputs.layer(rows, 8, 0) != inputs.layer(rows, 8, 1)).all()
    assert inputs.layer(rows, 8, 0).std() > 0.3  # neither dead nor saturated


def test_the_reference_is_the_mean_of_five_layers_by_scikit_learns_accuracy(suite: Suite, tmp_path: Path) -> None:
    """Every layer is probed by itself on the folds of the sites; none of them is chosen."""
    run = run_of(suite, tmp_path / "random")
    results = train_probes(run, permutations=0, controls=("random-features",), suite=suite.folder)
    inputs = inputs_of(run, suite)
    problem = problem_of(run)
    accuracies = []
    for number in range(5):
        layer = inputs.layer(problem.positions, WIDTH, derive_seed("binding", 0, number))
        decisions = problem.fit(Samples.pooled(layer)).decisions
        accuracies.append(accuracy_score(problem.labels, decisions > 0))
    assert len(set(accuracies)) > 1, "else the mean is the best"
    control = results.controls.of_category("color")["random-features"]
    assert control.score == pytest.approx(np.mean(accuracies))
    assert [comparison.reference for comparison in results.controls.comparisons] == pytest.approx(
        [np.mean(accuracies)] * 3
    )


TARGET = "dataset.state.x"


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return write_recorded_run(tmp_path / "run")


def probed_label(run: Run, **options: Any) -> ProbeResults:
    return train_probes(run, target=Target.of_run(run, TARGET), permutations=59, controls=(), **options)


@pytest.mark.slow
def test_a_site_that_an_untrained_network_has_too_is_no_signal(run: Run, tmp_path: Path) -> None:
    blind = write_recorded_run(tmp_path / "blind", weights="1" * 64, planted=False)
    seeing = write_recorded_run(tmp_path / "seeing", weights="2" * 64)
    against_blind = probed_label(run, untrained=blind).scores.set_index("layer")
    assert against_blind.loc[1, "exceeds_untrained"]
    assert against_blind.loc[1, "signal"]
    assert not against_blind.loc[0, "exceeds_untrained"]
    seeing_scores = probed_label(seeing).scores
    results = probed_label(run, untrained=seeing)
    against_seeing = results.scores.set_index("layer")
    assert not against_seeing.loc[1, "exceeds_untrained"]
    assert not against_seeing.loc[1, "signal"]
    assert against_seeing.loc[1, "best_control"] == seeing_scores["score"].max(), "the best site of the stream"
    assert [score.name for score in results.controls.scores] == ["untrained"], "the former one was replaced"
    assert results.key == load_results(run, target=TARGET).key


@pytest.mark.slow
def test_the_comparison_is_stored_and_not_made_again(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blind = write_recorded_run(tmp_path / "blind", weights="1" * 64, planted=False)
    first = probed_label(run, untrained=blind)
    monkeypatch.setattr("probe_kit.train.probe_sweep.probe_columns", None)
    for again in (probed_label(run, untrained=blind), probed_label(run), load_results(run, target=TARGET)):
        assert again.controls == first.controls
    monkeypatch.undo()
    extended = train_probes(run, target=Target.of_run(run, TARGET), permutations=59, controls=("state",))
    assert set(extended.controls.names) == {"untrained", "state"}
    answer = CliRunner().invoke(
        app,
        ["train", str(run.path), "--target", TARGET, "--permutations", "59", "--controls", "none", "--untrained",
         str(blind.path)],
        env={"COLUMNS": "200"},
    )  # fmt: skip
    assert "control untrained" in answer.stdout


@pytest.mark.slow
def test_other_frames_are_refused(run: Run, tmp_path: Path, labelled_run: Path) -> None:
    with pytest.raises(UsageError, match="cannot be its own untrained control"):
        probed_label(run, untrained=open_run(run.path))
    other = write_recorded_run(tmp_path / "other", weights="1" * 64, pixels=False)
    with pytest.raises(UsageError, match=r"another dataset than .*by the same command"):
        probed_label(run, untrained=other)
    with pytest.raises(UsageError, match="another dataset"):
        probed_label(run, untrained=open_run(labelled_run))
    fewer = write_recorded_run(tmp_path / "fewer", episodes=8, weights="1" * 64)
    with pytest.raises(UsageError, match=r"has no episode .*expected all"):
        probed_label(run, untrained=fewer)


@pytest.mark.slow
def test_later_inferences_of_networks_that_acted_are_refused(small_suite: Suite, tmp_path: Path) -> None:
    suite = small_suite.select([small_suite.categories[0]])
    run = write_labelled_run(tmp_path / "run", suite)
    other = write_labelled_run(tmp_path / "other", suite, weights="1" * 64)
    labels = Target.of_run(run, "sim.tool_y")
    with pytest.raises(UsageError, match="acted otherwise, so it saw other frames"):
        train_probes(run, target=labels, permutations=0, controls=(), untrained=other)
    first = train_probes(run, target=labels, permutations=0, controls=(), untrained=other, window=1)
    assert first.controls.names == ("untrained",)
