""""""

import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from probe_kit.errors import NoProbesError, RunDamagedError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.results import read_bundle, write_bundle
from probe_kit.runs.store import locate
from probe_kit.train import ArrayRun, load_results, save_results, train_probes
from probe_kit.train.results.inventory import inventory
from probe_kit.train.results.probe_results import FORMAT
from probe_kit.train.results.store import stored_targets

PlantedRun = Callable[..., ArrayRun]


def test_stored_results_equal_the_fitted_ones(planted_run: PlantedRun) -> None:
    run = planted_run({Site("backbone", 1): 1.0}, categories=("color", "shape"))
    fitted = train_probes(run, permutations=4)
    stored = load_results(run, fitted.key)
    assert stored.settings == fitted.settings
    pd.testing.assert_frame_equal(stored.scores, fitted.scores)
    for pair, curve in fitted.curves.items():
        for member in fields(curve):
            np.testing.assert_array_equal(
                getattr(stored.curves[pair], member.name), getattr(curve, member.name), member.name
            )


def test_probes_that_were_read_can_be_stored_again(planted_run: PlantedRun) -> None:
    """What a curve has computed of itself is not part of it."""
    run = planted_run()
    fitted = train_probes(run, permutations=1)
    stored = load_results(run, fitted.key)
    assert len(stored.scores) == len(stored.curves["color", "mean"].sums.accuracies)
    again = replace(stored, settings=replace(stored.settings, seed=1))
    assert len(again.scores) == len(stored.scores)
    save_results(again, run.path)
    read = load_results(run, again.key)
    np.testing.assert_array_equal(read.curves["color", "mean"].decisions, stored.curves["color", "mean"].decisions)


def test_the_folder_holds_settings_scores_and_decisions(planted_run: PlantedRun) -> None:
    run = planted_run()
    results = train_probes(run, permutations=2, controls=())
    folder = run.path / "probes" / results.key
    assert sorted(path.name for path in folder.iterdir()) == [
        "decisions.npz", "directions.npz", "scores.csv", "settings.json", "times.json",
    ]  # fmt: skip
    scores = pd.read_csv(folder / "scores.csv")
    np.testing.assert_allclose(scores["accuracy"], results.scores["accuracy"])
    assert (scores["settings"] == results.key).all()


def leave_behind(folder: Path, key: str) -> None:
    """What processes killed in the middle of writing leave of a bundle."""
    for torn in (folder / key / "abc.tmp", folder / f".{key}.partial" / "mean+backbone.00.residual.npz"):
        torn.parent.mkdir(parents=True, exist_ok=True)
        torn.write_text("torn", encoding="utf-8")


@pytest.mark.parametrize("finished", [True, False], ids=["killed at the end", "killed before the settings"])
def test_what_a_killed_training_left_is_cleared_by_the_next_one(planted_run: PlantedRun, finished: bool) -> None:
    run = planted_run()
    results = train_probes(run, permutations=1)
    probes = run.path / "probes"
    files = {path.name for path in probes.rglob("*")}
    if not finished:
        (probes / results.key / "settings.json").unlink()
        (probes / f".{results.key}.partial").mkdir()  # else it is damage
        (probes / results.key / "abc.tmp").write_text("torn", encoding="utf-8")
    else:
        leave_behind(probes, results.key)
    train_probes(run, permutations=1)
    assert {path.name for path in probes.rglob("*")} == files


@pytest.mark.slow
def test_the_newest_results_for_the_target_are_loaded(planted_run: PlantedRun) -> None:
    run = planted_run()
    train_probes(run, permutations=1)
    newest = train_probes(run, permutations=2)
    control = train_probes(run, permutations=1, target="side.shuffled")
    assert load_results(run).key == newest.key
    assert load_results(run, target="side.shuffled").key == control.key


def test_results_of_fewer_episodes_are_not_taken_for_current(planted_run: PlantedRun) -> None:
    run = planted_run()
    train_probes(run, permutations=1)
    shorter = ArrayRun(
        run.path,
        run.model,
        run.suite,
        run.episodes[:60],
        {pair: array[:60] for pair, array in run.features.items()},
    )
    with pytest.raises(NoProbesError, match="probe-kit train"):
        load_results(shorter)


def test_an_unknown_key_lists_the_known_ones(planted_run: PlantedRun) -> None:
    run = planted_run()
    key = train_probes(run, permutations=0).key
    with pytest.raises(UsageError, match=key):
        load_results(run, "ffffffffffff")


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "times.json"}


def test_the_same_probes_have_the_same_bytes_whenever_they_were_fitted(
    planted_run: PlantedRun, tmp_path: Path
) -> None:
    """Killed and begun anew or not: only the record of times tells when."""
    run = planted_run()
    folder = run.path / "probes" / train_probes(run, permutations=1).key
    first, times = files_of(folder), (folder / "times.json").read_bytes()
    shutil.move(folder, tmp_path / "before")
    train_probes(run, permutations=1)
    assert files_of(folder) == first
    assert (folder / "times.json").read_bytes() != times


def test_saving_keeps_what_is_there(planted_run: PlantedRun) -> None:
    run = planted_run()
    results = train_probes(run, permutations=0)
    file = run.path / "probes" / results.key / "scores.csv"
    file.write_text("edited by hand", encoding="utf-8")
    save_results(results, run.path)
    assert file.read_text(encoding="utf-8") == "edited by hand"


@pytest.mark.parametrize(
    "stored_format",
    [*(pytest.param(other, marks=pytest.mark.slow) for other in (1, FORMAT - 1, None)), FORMAT + 1, "labels-3"],
)
def test_results_of_another_format_are_refused_by_its_name(
    planted_run: PlantedRun, stored_format: int | str | None
) -> None:
    run = planted_run()
    train_probes(run, permutations=2)
    other = {"format": stored_format, "model": "m"}
    write_bundle(locate(run.path), "probes", sha256_json(other)[:12], {"settings": other})
    for read in (load_results, inventory, stored_targets):
        with pytest.raises(RunDamagedError, match=rf"has format {stored_format}; .* reads format {FORMAT}"):
            read(run)


FORGED: dict[str, Callable[[NDArray[Any]], NDArray[Any]]] = {
    "another length": lambda array: np.concatenate([array, array[:1]]),
    "an axis more": lambda array: array[None],
    "texts": lambda array: np.full(array.shape, "x") if array.dtype.kind != "U" else np.zeros(array.shape),
}


@pytest.mark.parametrize("forged", FORGED)
@pytest.mark.parametrize(
    "member",
    [
        "decisions",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("labels", "groups", "null", "sites", "direction")
        ),
    ],
)
def test_arrays_of_probes_that_contradict_each_other_are_damage(
    planted_run: PlantedRun, member: str, forged: str
) -> None:
    """As in a forged run, whose sums were made anew."""
    run = planted_run()
    results = train_probes(run, permutations=1, controls=())
    name = "directions.npz" if member == "direction" else "decisions.npz"
    bundle = read_bundle(locate(run.path), "probes", results.key)
    with np.load(BytesIO(bundle.read(name))) as opened:
        arrays = dict(opened)
    ending = "/weights" if member == "direction" else f"/{member}"
    changed = next(array for array in arrays if array.endswith(ending))
    arrays[changed] = FORGED[forged](arrays[changed])
    file = BytesIO()
    np.savez(file, **arrays)
    write_bundle(locate(run.path), "probes", results.key, bundle.head, {name: file.getvalue()}, bundle.times)
    stem = name.partition(".")[0]
    with pytest.raises(RunDamagedError, match=f"{stem}.* has .*{ending[1:]}.*Remove probes/"):
        dict(load_results(run, results.key).directions)


@pytest.mark.slow
def test_probes_that_are_asked_for_again_are_the_newest(planted_run: PlantedRun) -> None:
    run = planted_run()
    first = train_probes(run, permutations=1)
    train_probes(run, permutations=2)
    again = train_probes(run, permutations=1)
    assert again.created == first.created
    assert load_results(run).key == first.key


@pytest.mark.slow
def test_results_are_loaded_by_their_key_beside_damaged_ones(planted_run: PlantedRun) -> None:
    run = planted_run()
    intact, damaged = (train_probes(run, permutations=count).key for count in (0, 1))
    (run.path / "probes" / damaged / "settings.json").write_bytes(b"{}")
    assert load_results(run, intact).key == intact
    with pytest.raises(RunDamagedError, match=damaged):
        load_results(run, damaged)
    with pytest.raises(RunDamagedError, match=damaged):
        load_results(run)


def test_the_beginning_of_a_key_will_do(planted_run: PlantedRun) -> None:
    run = planted_run()
    key = train_probes(run, permutations=1).key
    assert load_results(run, key[:6]).key == key
    with pytest.raises(UsageError, match="no probe results ''"):
        load_results(run, "")


@pytest.mark.slow
def test_probes_of_all_categories_together_do_not_hide_those_by_category(planted_run: PlantedRun) -> None:
    run = planted_run({Site("backbone", 1): 1.0}, categories=("color", "shape"))
    by_category = train_probes(run, permutations=2, controls=())
    pooled = train_probes(run, ["all"], permutations=2, controls=())
    assert load_results(run).key == by_category.key
    assert load_results(run, pooled.key).settings.categories == ("all",)
    only_color = train_probes(run, ["color"], permutations=2, controls=())
    assert load_results(run).key == only_color.key, "the newest of those by category"
