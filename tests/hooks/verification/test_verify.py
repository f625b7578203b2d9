import gzip
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from probe_kit.errors import UsageError, WeightsError
from probe_kit.hooks.verification.verify import compare, verify_keys, verify_reference

MUST_AGREE = {
    "actions",
    "actions_unnormalized",
    "backbone_resid",
    "backbone_final_norm",
    "expert_resid",
    "expert_final_norm",
    "velocity",
    "x_t",
    "vision_resid",
    "prep_images",
}


@pytest.fixture(params=["pi0", "smolvla"])
def reference(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    """A golden reference a test may damage, as (family, folder)."""
    folder = request.getfixturevalue(f"golden_{request.param}")
    return request.param, Path(shutil.copytree(folder, tmp_path / request.param))


def test_the_adapter_reproduces_the_original_implementation(reference: tuple[str, Path]) -> None:
    verification = verify_reference(*reference)
    status = {c.output: c.status for c in verification.comparisons}
    assert {name for name, found in status.items() if found == "ok"} >= MUST_AGREE
    assert verification.passed


def test_what_cannot_be_produced_is_listed_and_not_passed(reference: tuple[str, Path]) -> None:
    verification = verify_reference(*reference)
    assert {c.output for c in verification.comparisons if c.status == "not compared"} >= {"train_loss"}


def test_one_wrong_number_in_the_reference_is_noticed(reference: tuple[str, Path]) -> None:
    family, folder = reference
    with np.load(folder / "reference.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays.files}
    recorded["expert_resid"][7, 1, 0, 0, 0] += 0.001
    np.savez(folder / "reference.npz", **recorded)
    verification = verify_reference(family, folder)
    assert not verification.passed
    assert [c.output for c in verification.comparisons if c.status == "over"] == ["expert_resid"]


@pytest.mark.parametrize("damage", ["deleted", "renamed", "mis-shaped", "nan"])
def test_a_damaged_checkpoint_is_refused_by_tensor_name(reference: tuple[str, Path], damage: str) -> None:
    family, folder = reference
    file = folder / "checkpoint" / "model.safetensors"
    tensors = load_file(file)
    name = "model.action_out_proj.weight"
    original = tensors.pop(name)
    if damage == "renamed":
        tensors["model.action_out_porj.weight"] = original
    elif damage == "mis-shaped":
        tensors[name] = original[:-1].clone()
    elif damage == "nan":
        tensors[name] = torch.full_like(original, torch.nan)
    save_file(tensors, file)
    with pytest.raises(WeightsError, match=r"action_out_proj\.weight") as caught:
        verify_reference(family, folder)
    assert caught.value.exit_code == 3


def test_full_size_keys_are_equal(reference: tuple[str, Path]) -> None:
    family, folder = reference
    assert verify_keys(family, folder / "real_keys.json.gz").passed


def test_a_key_of_another_shape_is_named(reference: tuple[str, Path], tmp_path: Path) -> None:
    family, folder = reference
    recorded = json.loads(gzip.decompress((folder / "real_keys.json.gz").read_bytes()))
    recorded["keys"]["model.state_proj.bias"]["shape"] = [7]
    (tmp_path / "keys.json").write_text(json.dumps(recorded), encoding="utf-8")
    verification = verify_keys(family, tmp_path / "keys.json")
    assert not verification.passed
    assert "model.state_proj.bias" in verification.comparisons[0].note


def test_a_folder_without_a_reference_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"reference\.npz"):
        verify_reference("pi0", tmp_path)


def test_a_reference_that_asks_for_a_password_is_refused_by_name(tmp_path: Path) -> None:
    file = tmp_path / "reference.npz"
    np.savez(file, a=np.zeros(3))
    content = bytearray(file.read_bytes())
    for header, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(header) + flags] |= 1
    file.write_bytes(content)
    with pytest.raises(UsageError, match=r"reference\.npz cannot be read as arrays .*password"):
        verify_reference("pi0", tmp_path)


def test_nan_and_another_shape_are_never_ok() -> None:
    recorded = {"a": np.zeros(3), "b": np.zeros(3), "c": np.zeros(3), "in_x": np.zeros(1)}
    produced = {"a": lambda: np.array([0, np.nan, 0]), "b": lambda: np.zeros(4)}
    found = {c.output: c.status for c in compare(recorded, produced, 1e-5, {})}
    assert found == {"a": "over", "b": "over", "c": "not compared"}
