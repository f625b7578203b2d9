"""Actions are in the units that the checkpoint's own files give, in every family with several statistics."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UnitsError, UsageError
from probe_kit.extract.sources.source import check_units, compare_states
from probe_kit.hooks import load_policy
from probe_kit.hooks.registry import find_family, own_families
from tests.hooks.families.groot.checkpoints import write_nvidias
from tests.support.every_checkpoint import WRITERS
from tests.support.slow_cases import slow_but

UNITS = {"action": {"q01": [-0.5] * 7, "q99": [0.5] * 7, "mask": [True] * 6 + [False]}}
FAMILIES = ("openvla", "magma", "internvla-m1", pytest.param("spatialvla", marks=pytest.mark.slow))
DEFAULTS = {
    "openvla": {"unnorm_key": "bridge_orig"},
    "spatialvla": {"unnorm_key": "bridge_orig/1.0.0"},
    "magma": {"unnorm_key": "bridge_orig"},
    "internvla-m1": {"unnorm_key": "bridge_dataset"},
    "xiaomi-r0": {"robot": "bridge_delta"},
}


def tuned(family: str, folder: Path, *names: str) -> Path:
    """A tiny checkpoint with the file that fine-tuning writes."""
    checkpoint = WRITERS[family][0](folder)
    (checkpoint / "dataset_statistics.json").write_text(json.dumps(dict.fromkeys(names, UNITS)), encoding="utf-8")
    return checkpoint


@pytest.mark.parametrize("family", FAMILIES)
def test_what_fine_tuning_wrote_stands_alone_and_the_only_set_needs_no_name(family: str, tmp_path: Path) -> None:
    checkpoint = tuned(family, tmp_path / "tuned", "my_arm")
    assert load_policy(family, str(checkpoint)).card.settings["unnorm_key"] == "my_arm"
    for name in DEFAULTS[family].values():
        with pytest.raises(UsageError, match=rf"no action statistics of '{name}'.*my_arm"):
            load_policy(family, str(checkpoint), unnorm_key=name)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["openvla", "spatialvla", "internvla-m1"])
def test_several_sets_have_to_be_chosen_from_before_anything_is_loaded(family: str, tmp_path: Path) -> None:
    other = next(iter(DEFAULTS[family].values()))
    checkpoint = tuned(family, tmp_path / "tuned", "my_arm", other)
    with pytest.raises(UsageError, match=f"with -M unnorm_key=NAME: {other}, my_arm"):
        find_family(family).whose_units(str(checkpoint))
    with pytest.raises(UsageError, match=f"with -M unnorm_key=NAME: {other}, my_arm"):
        load_policy(family, str(checkpoint))
    policy = load_policy(family, str(checkpoint), unnorm_key="my_arm")
    assert policy.card.settings["unnorm_key"] == "my_arm"


def test_a_magma_without_chosen_units_answers_and_does_not_act(tmp_path: Path) -> None:
    checkpoint = WRITERS["magma"][0](tmp_path / "model")
    model = load_policy("magma", str(checkpoint))
    assert "-M unnorm_key=bridge_orig" in str(model.embodiment_mismatch())
    assert model.card.settings["unnorm_key"] == "none"
    packaged = load_policy("magma", str(checkpoint), unnorm_key="bridge_orig")
    assert packaged.embodiment_mismatch() is None


def test_a_robot_among_several_has_to_be_chosen(tmp_path: Path) -> None:
    checkpoint = WRITERS["xiaomi-r0"][0](tmp_path / "model")
    with pytest.raises(UsageError, match="with -M robot=NAME: bridge_delta, "):
        load_policy("xiaomi-r0", str(checkpoint))
    path = checkpoint / "preprocessor_config.json"
    values = json.loads(path.read_text(encoding="utf-8"))
    values["action_config"] = {"fractal_delta": values["action_config"]["fractal_delta"]}
    path.write_text(json.dumps(values), encoding="utf-8")
    assert load_policy("xiaomi-r0", str(checkpoint)).card.settings["robot"] == "fractal_delta"


def test_statistics_of_an_adapters_folder_count_over_those_of_its_base(tmp_path: Path) -> None:
    WRITERS["openvla"][0](tmp_path / "base")
    folder = tmp_path / "adapter"
    folder.mkdir()
    settings = {"peft_type": "LORA", "base_model_name_or_path": "../base"}
    (folder / "adapter_config.json").write_text(json.dumps(settings), encoding="utf-8")
    (folder / "adapter_model.safetensors").write_bytes(b"")
    (folder / "dataset_statistics.json").write_text(json.dumps({"my_arm": UNITS}), encoding="utf-8")
    family = find_family("openvla")
    assert family.whose_units(str(folder)).startswith("my_arm, from ")
    (folder / "dataset_statistics.json").unlink()
    assert family.whose_units(str(folder)).startswith("bridge_orig, from config.json in ")


@pytest.mark.parametrize("family", list(DEFAULTS))
def test_the_default_checkpoint_alone_has_default_units(family: str) -> None:
    entry = find_family(family)
    assert entry.checkpoints.of_default == DEFAULTS[family]
    released = entry.check(random_weights=True, fetch=False, device="cpu")
    assert released.items() >= DEFAULTS[family].items()
    assert not entry.check("someone/fine-tune", random_weights=True, fetch=False).keys() & DEFAULTS[family].keys()


@pytest.mark.slow
def test_the_plan_prints_whose_units_are_used(tmp_path: Path) -> None:
    checkpoint = tuned("openvla", tmp_path / "tuned", "my_arm")
    command = [
        "extract",
        "--model",
        "openvla",
        "--checkpoint",
        str(checkpoint),
        "--items",
        "12",
    ]
    result = CliRunner().invoke(app, [*command, "--dry-run"])
    assert "units" in result.output
    assert "my_arm, from" in " ".join(result.output.split())


ACTING = {name: writer for name, writer in WRITERS.items() if own_families()[name].abilities.acts}
MADE: dict[str, tuple[str, Callable[[Path], Path], dict[str, Any]]] = {
    **{name: (name, *arguments) for name, arguments in ACTING.items()},
    "groot of NVIDIA": ("groot", write_nvidias, {"embodiment": "libero_sim"}),
    "pi0 of Bridge": ("pi0", ACTING["pi0"][0], {"statistics": "bridge"}),
}
UNGUARDED = {
    "openvla": "no state is read",
    "spatialvla": "no state is read",
    "magma": "no state is read",
    "internvla-m1": "no state is read",
    "xiaomi-r0": "statistics of actions alone",
    "pi0": "leaves the units of its observation.state to its evaluation",
}
LOADED = {"openvla", "xiaomi-r0", "pi0", "pi0 of Bridge", "pi05", "molmoact2", "groot of NVIDIA", "eo1"}
"""With each reason, and with each way to read statistics of a state; the others share one of these."""
NOTE = "units of states are not compared with statistics: "


@pytest.mark.parametrize("name", slow_but(LOADED, MADE))
def test_a_state_in_other_units_is_refused_or_the_family_says_why_it_is_not_compared(
    name: str, tmp_path: Path
) -> None:
    family, write, options = MADE[name]
    policy = load_policy(family, str(write(tmp_path / "model")), **options)
    notes = [note for note in policy.card.notes if note.startswith(NOTE)]
    if name in UNGUARDED:
        assert policy.unguarded_state is not None
        assert UNGUARDED[name] in policy.unguarded_state
        assert notes == ([] if policy.state_numbers is None else [NOTE + policy.unguarded_state])
        return
    assert policy.unguarded_state is None
    assert notes == []
    assert policy.state_numbers is not None
    far = np.full((4, policy.state_numbers), 1e4, np.float32)
    names = [str(number) for number in range(policy.state_numbers)]
    for begins in (True, False):
        units = compare_states(policy, [far], names, begins=begins)
        assert units.shares.tolist() == [1.0] * policy.state_numbers
        with pytest.raises(UnitsError, match=r"the source: .*do not fit the statistics of .*--accept-units"):
            check_units(units, "the source", policy, False)
        check_units(units, "the source", policy, True)


def test_a_state_that_a_checkpoint_reads_as_it_is_is_named(tmp_path: Path) -> None:
    policy = load_policy("pi0", str(ACTING["pi0"][0](tmp_path / "model")), statistics="none")
    assert f"{NOTE}the state is IDENTITY by -M statistics=none" in policy.card.notes
