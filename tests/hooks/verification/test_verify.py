import gzip
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from probe_kit.errors import UsageError, WeightsError
from probe_kit.hooks.outputs import Outputs
from probe_kit.hooks.verify import compare, verify_keys, verify_reference
from probe_kit.models.magma import UNUSED_WEIGHTS


@pytest.fixture(params=["pi0", "smolvla"])
def reference(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    """A golden reference a test may damage, as (family, folder)."""
    folder = request.getfixturevalue(f"golden_{request.param}")
    return request.param, Path(shutil.copytree(folder, tmp_path / request.param))


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


def test_a_key_of_another_shape_is_named(reference: tuple[str, Path], tmp_path: Path) -> None:
    family, folder = reference
    other = {"model.state_proj.bias": {"shape": [7], "dtype": "float32"}}
    verification = verify_keys(family, write_keys(folder / "real_keys.json.gz", tmp_path / "keys.json", **other))
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
    found = {c.output: c.status for c in compare(recorded, Outputs(produced))}
    assert found == {"a": "over", "b": "over", "c": "not compared"}


def test_a_reference_without_its_questions_is_refused(golden_vlm: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(golden_vlm / "paligemma", tmp_path / "golden"))
    (copy / "dims.json").unlink()
    with pytest.raises(UsageError, match=r"dims\.json is missing"):
        verify_reference("paligemma", copy)


def write_keys(source: Path, file: Path, gone: tuple[str, ...] = (), **added: object) -> Path:
    """Write a recorded list without some tensors and with others."""
    keys = json.loads(gzip.decompress(source.read_bytes()))["keys"]
    kept = {name: entry for name, entry in keys.items() if name not in gone}
    file.write_text(json.dumps({"keys": kept | added}), encoding="utf-8")
    return file


def test_a_tensor_that_is_not_recorded_is_named(golden_vlm: Path, tmp_path: Path) -> None:
    gone = ("model.vision_tower.encoder.layer.3.lambda_1", "lm_head.weight")
    file = write_keys(golden_vlm / "internvl/real_keys.8B.json.gz", tmp_path / "keys.json", gone)
    verification = verify_keys("internvl", file)
    assert not verification.passed
    assert all(f"{name}: not recorded" in verification.comparisons[0].note for name in gone)


def test_tensors_that_the_family_declares_may_be_missing_and_no_other(golden_magma: Path, tmp_path: Path) -> None:
    source = golden_magma / "real_keys.json.gz"
    left_out = verify_keys("magma", source).comparisons[1]
    assert left_out.status == "not compared"
    assert all(name in left_out.note for name in UNUSED_WEIGHTS)
    for name in ("vision_tower.clip_vision_model.trunk.headless", "multi_modal_projector.row_separator"):
        entry = {"shape": [3], "dtype": "bfloat16"}
        verification = verify_keys("magma", write_keys(source, tmp_path / "keys.json", **{name: entry}))
        assert not verification.passed
        assert f"{name}: missing here" in verification.comparisons[0].note
