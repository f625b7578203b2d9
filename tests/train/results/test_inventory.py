from collections.abc import Callable

from probe_kit.hooks import Site
from probe_kit.train import ArrayRun, train_probes
from probe_kit.train.results.inventory import inventory

PlantedRun = Callable[..., ArrayRun]


def test_a_run_lists_its_probes_oldest_first_and_which_are_used(planted_run: PlantedRun) -> None:
    run = planted_run({Site("backbone", 1): 1.0})
    assert inventory(run).probes == ()
    first = train_probes(run, permutations=1, controls=("position",))
    second = train_probes(run, permutations=2, target="side.shuffled", seed=7)
    found = inventory(run)
    assert [(probes.key, probes.state) for probes in found.probes] == [(first.key, "used"), (second.key, "other")]
    assert [(probes.target, probes.seed, probes.controls) for probes in found.probes] == [
        ("side.correct", 0, ("position",)),
        ("side.shuffled", 7, ()),
    ]
    assert (found.episodes, found.planned, sum(found.outcomes.values())) == (80, 80, 80)
    assert found.streams["expert"] == "2 layers × 2 iterations, width 8; views mean"


def test_probes_of_other_episodes_are_named(planted_run: PlantedRun) -> None:
    run = planted_run()
    train_probes(run, permutations=0)
    shorter = {pair: array[:60] for pair, array in run.features.items()}
    fewer = ArrayRun(run.path, run.model, run.suite, run.episodes[:60], shorter)
    assert [probes.state for probes in inventory(fewer).probes] == ["other episodes"]
