"""Runs of schema 3 are read with the same numbers, and not continued."""

import json
import shutil
import tarfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import RunDamagedError, SettingsMismatchError, UsageError
from probe_kit.extract import ExtractSettings, extract_run, label_run, open_run, seal, verify_run
from probe_kit.extract.store.format.hashes import as_record
from probe_kit.extract.store.run import NotSealedWarning
from probe_kit.intervene import load_effects
from probe_kit.retention import retention_table
from probe_kit.suite import Suite
from probe_kit.train import load_results, train_probes
from tests.support.stored_numbers import numbers_of

FIXTURE = Path(__file__).parents[2] / "golden/run-schema-3"
STORED = json.loads((FIXTURE / "numbers.json").read_text(encoding="utf-8"))
NAMES = sorted(STORED)


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`little`, with probes and an intervention, and `acted`, a real run of pi0-tiny that was not sealed."""
    folder = tmp_path_factory.mktemp("schema-3")
    with tarfile.open(FIXTURE / "runs.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


@pytest.fixture
def copied(unpacked: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(unpacked, tmp_path / "copy"))


@pytest.mark.parametrize("name", NAMES)
def test_every_number_is_read_as_it_was_when_it_was_written(unpacked: Path, name: str) -> None:
    run, before = open_run(unpacked / name), STORED[name]
    assert run.root.schema == 3
    for part in ("stamp", "settings_sha256", "label", "suite"):
        assert getattr(run, part) == before[part]
    assert run.root.identity == before["identity"]
    assert numbers_of(run) == before["numbers"]
    columns = before["episodes"][0].split(",")
    assert run.episodes[columns].to_csv(index=False).splitlines() == before["episodes"]
    assert verify_run(unpacked / name, deep=True).ok


@pytest.mark.parametrize("name", NAMES)
def test_what_schema_3_does_not_hold_is_not_made_up(unpacked: Path, name: str) -> None:
    run = open_run(unpacked / name)
    assert run.suite_parent is None
    assert run.items["content_sha256"].isna().all()
    assert run.episodes[["seconds_inference", "seconds_simulation"]].isna().all(axis=None)
    with pytest.raises(UsageError, match="has schema 3, which does not hold the control steps"):
        _ = run.control_steps
    with pytest.raises(UsageError, match="has schema 3, in which the label is part of the run's identity"):
        label_run(run.location, "another")


def test_its_probes_are_found_again_and_new_ones_are_fitted_to_the_same_numbers(copied: Path) -> None:
    run = open_run(copied / "little")
    stored = {name.rpartition(" ")[2] for name in STORED["little"]["numbers"] if name.startswith("decisions")}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # pictures of its suite are not there
        again = train_probes(run, permutations=1, seed=1)
        assert again.key in stored
        kept = load_results(run, again.key).curves
        shutil.rmtree(copied / "little/probes")
        anew = train_probes(open_run(copied / "little"), permutations=1, seed=1)
    assert anew.key == again.key
    for place, curve in kept.items():
        np.testing.assert_allclose(anew.curves[place].decisions, curve.decisions, atol=1e-6)


def test_retention_and_stored_interventions_are_read(unpacked: Path) -> None:
    assert {row.run.label for row in retention_table([open_run(unpacked / "acted")]).rows} == {"a tiny run"}
    assert len(load_effects(open_run(unpacked / "little")).table)


def test_it_is_sealed_anew_with_the_same_columns(copied: Path) -> None:
    with pytest.warns(NotSealedWarning):
        open_run(copied / "acted").column(open_run(copied / "acted").sites("backbone")[0])
    assert seal(copied / "acted")
    run = open_run(copied / "acted")
    assert run.sealed
    assert numbers_of(run) == STORED["acted"]["numbers"]


def test_the_same_command_does_not_continue_it_and_says_so_before_a_model_is_loaded(
    small_suite: Suite, copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = copied / "acted"
    before = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}
    settings = ExtractSettings(
        "pi0-tiny", random_weights=True, suite=small_suite.folder, categories=("color",), items=2,
        scene=SceneSpec(max_steps=2), execute=1, frames="none", label="a tiny run",
    )  # fmt: skip

    def load_policy(*_: object, **__: object) -> None:
        raise AssertionError("a model was loaded")

    monkeypatch.setattr("probe_kit.hooks.load_policy", load_policy)
    with pytest.raises(SettingsMismatchError, match=r"a run of schema 3.*can be read, .* not continued"):
        extract_run(settings, place)
    assert {path: path.read_bytes() for path in place.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("record", "edit"),
    [
        ("run.json", {"schema_version": 4}),
        ("commits/00000001.json", {"episode": 0}),
        ("commits/00000001.json", {"control_steps": [3, 1]}),
    ],
)
def test_a_changed_record_of_it_is_damage_also_where_its_hash_was_computed_anew(
    copied: Path, record: str, edit: dict[str, Any]
) -> None:
    path = copied / "acted" / record
    content = json.loads(path.read_text(encoding="utf-8"))
    content.pop("blake2b")
    path.write_bytes(as_record({**content, **edit}))
    with pytest.raises(RunDamagedError):
        open_run(copied / "acted")
