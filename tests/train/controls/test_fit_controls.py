from collections.abc import Callable

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.hooks import Site
from probe_kit.train import ArrayRun, load_results, train_probes
from probe_kit.train.results.inventory import inventory

PlantedRun = Callable[..., ArrayRun]
PLANTED = Site("backbone", 3)


def named(run: ArrayRun, model: str, **changes: object) -> ArrayRun:
    """A copy in a folder of its own."""
    members = {**vars(run), "path": run.path.parent / model, "model": model, **changes}
    known = ArrayRun.__annotations__
    return ArrayRun(**{name: value for name, value in members.items() if name in known})


def test_baselines_of_a_fair_suite_are_at_chance_and_stored(planted_run: PlantedRun) -> None:
    run = planted_run({PLANTED: 2.0})
    train_probes(run, permutations=40, controls=("position", "instruction"))
    found = load_results(run).controls.of_category("color")
    assert set(found) == {"position", "instruction"}
    for score in found.values():
        assert not score.above_chance
        assert score.ci[0] <= score.score <= score.ci[1]
        assert (score.n, score.chance) == (80, 0.5)


@pytest.mark.slow
def test_a_suite_that_keeps_the_answer_on_one_side_is_found_out(planted_run: PlantedRun) -> None:
    run = planted_run()
    run.episodes["side_correct"] = run.episodes["layout"].map({"original": "left", "swapped": "right"})
    score = train_probes(run, permutations=40, controls=("position",)).controls.of_category("color")["position"]
    assert score.score == 1.0
    assert score.above_chance


def test_controls_are_added_to_stored_probes_without_fitting_those_again(planted_run: PlantedRun) -> None:
    run = planted_run()
    first = train_probes(run, permutations=5, controls=("position",))
    again = train_probes(run, permutations=5, controls=("position", "instruction"))
    assert again.created == first.created
    assert again.controls.of_category("color")["position"] == first.controls.of_category("color")["position"]
    assert "instruction" in again.controls.of_category("color")


def test_the_untrained_network_is_subtracted_per_site_and_per_peak(planted_run: PlantedRun) -> None:
    trained, untrained = planted_run({PLANTED: 2.0}), named(planted_run(), "random", random_weights=True)
    results = train_probes(trained, permutations=5, untrained=untrained)
    accuracy = results.curves["color", "mean"].correct.mean(axis=1)
    others = load_results(untrained).curves["color", "mean"].correct.mean(axis=1)
    sites = [score for score in results.controls.untrained if not score.peak]
    np.testing.assert_allclose([score.difference for score in sites], accuracy - others, atol=1e-12)
    assert sites[3].ci[0] > 0.2
    assert sites[3].ci[0] < sites[3].difference < sites[3].ci[1] < accuracy[3]
    assert sites[2].difference == 0.0, "the same features in both runs"
    unseen = 1 - 0.025 ** (1 / 20)
    assert 0.5 * unseen < sites[2].ci[1] < unseen, "20 groups that agree are no certainty"
    assert sites[2].ci[0] == pytest.approx(-sites[2].ci[1], abs=0.03)
    peak = results.controls.untrained_peak("color", "mean", "backbone")
    assert peak is not None
    assert (peak.site, peak.untrained) == (str(PLANTED), "random (random weights)")
    assert peak.difference == pytest.approx(accuracy.max() - others[:5].max())


def test_an_untrained_network_of_other_episodes_is_refused(planted_run: PlantedRun) -> None:
    run = planted_run()
    episodes = run.episodes.assign(episode_id="other-" + run.episodes["episode_id"])
    with pytest.raises(UsageError, match="not the same"):
        train_probes(run, permutations=0, untrained=named(run, "random", episodes=episodes))


def test_an_untrained_network_of_other_episodes_costs_no_work(planted_run: PlantedRun) -> None:
    run = planted_run()
    episodes = run.episodes.assign(episode_id="other-" + run.episodes["episode_id"])
    done: list[int] = []
    with pytest.raises(UsageError, match="not the same"):
        train_probes(
            run,
            permutations=0,
            untrained=named(run, "random", episodes=episodes),
            progress=lambda *at: done.append(at[0]),
        )
    assert not done


def test_a_run_is_not_its_own_untrained_control(planted_run: PlantedRun) -> None:
    run = planted_run()
    with pytest.raises(UsageError, match="its own untrained control"):
        train_probes(run, permutations=0, untrained=run)


def test_the_probes_of_an_untrained_network_are_read_only_where_no_others_were_asked_for(
    planted_run: PlantedRun,
) -> None:
    run, control = planted_run({PLANTED: 2.0}), named(planted_run(), "random", random_weights=True)
    own = train_probes(control, permutations=3)
    with_untrained = train_probes(run, permutations=2, untrained=control)
    assert load_results(control).key == own.key
    assert with_untrained.settings.permutations == 2
    assert {probes.state for probes in inventory(control).probes} == {"used", "other"}
    other = named(planted_run(), "other random", random_weights=True)
    train_probes(run, permutations=2, untrained=other)
    assert load_results(other).settings.permutations == 2


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
def test_what_is_wrong_is_said_before_any_work_and_leaves_what_retention_reads(
    planted_run: PlantedRun, options: dict[str, object]
) -> None:
    run = planted_run(n_items=12)
    before = train_probes(run, permutations=1, views=("mean",))
    files = sorted(run.path.rglob("*"))
    done: list[int] = []
    asked: dict[str, object] = {"permutations": 2, **options}
    with pytest.raises(UsageError):
        train_probes(run, **asked, progress=lambda *at: done.append(at[0]))  # type: ignore[arg-type]
    assert not done
    assert load_results(run).key == before.key
    assert sorted(run.path.rglob("*")) == files


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
