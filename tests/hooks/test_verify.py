"""Every family against what the original implementation put out, and a reference with wrong numbers in it."""

import gzip
import json
import shutil
from functools import cache
from math import prod
from pathlib import Path

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.hooks.families.magma.network import UNUSED_WEIGHTS
from probe_kit.hooks.family import Family
from probe_kit.hooks.outputs import Outputs
from probe_kit.hooks.registry import own_families
from probe_kit.hooks.verify import Verification, compare, verify_keys, verify_reference

GOLDEN = Path(__file__).parents[1] / "golden"
BYTES = {"float32": 4, "bfloat16": 2, "int64": 8}
_TRAINING = {"train_actions", "train_loss", "train_losses", "train_noise", "train_time"}
UNPRODUCED = {
    "pi0": {*_TRAINING, "suffix_position_ids", "train_grad_action_out_proj_weight", "train_grad_backbone_q_proj0"},
    "smolvla": {
        *_TRAINING, "prefix_att", "prefix_attention_2d", "prefix_position_ids", "suffix_position_ids",
    },
    **{
        f"vlm/{name}": {"greedy_ids_hub_settings"}  # with the penalties of a file that the tool does not follow
        for name in ("paligemma", "qwen2_5_vl", "qwen3_vl", "internvl", "ovis2_5")
    },
}  # fmt: skip
"""Recorded quantities that no adapter makes, by reference."""
MASKS = {"attention_mask", "prefix_pad"}
"""Recorded quantities that also say where others are compared."""
REFERENCES = {
    "pi0": ("pi0", 17),
    "pi05": ("pi05", 15),
    "pi0_fast": ("pi0-fast", 11),
    "molmoact2": ("molmoact2", 13),
    "groot": ("groot", 10),
    "xvla": ("xvla", 7),
    "eo1": ("eo1", 13),
    "smolvla": ("smolvla", 17),
    "openvla": ("openvla", 23),
    "prismatic": ("prismatic", 6),
    "spatialvla": ("spatialvla", 28),
    "magma": ("magma", 29),
    "xiaomi_r0": ("xiaomi-r0", 15),
    "internvla_m1": ("internvla-m1", 20),
    "vlm/paligemma": ("paligemma", 17),
    "vlm/qwen2_5_vl": ("qwen2.5-vl", 19),
    "vlm/qwen3_vl": ("qwen3-vl", 18),
    "vlm/internvl": ("internvl", 16),
    "vlm/ovis2_5": ("ovis2.5", 17),
    "vlm/prismatic": ("prismatic", 14),
}
"""By folder, the family and how many quantities agree."""
KEYS = [
    pytest.param(family, file, marks=() if "vlm" not in folder or "hub" in file.name else pytest.mark.slow)
    for folder, (family, _) in REFERENCES.items()
    for file in sorted((GOLDEN / folder).glob("*keys*.json.gz"))
]
"""Every recorded list of tensors; a released size is named in its file."""


def test_every_family_with_a_checkpoint_of_its_own_has_a_reference() -> None:
    with_reference = {family for family, _ in REFERENCES.values()}
    assert with_reference == {name for name in own_families() if "-tiny" not in name}


@cache
def verified(folder: str) -> Verification:
    return verify_reference(REFERENCES[folder][0], GOLDEN / folder)


@pytest.mark.parametrize("folder", REFERENCES)
def test_every_recorded_quantity_is_reproduced(folder: str) -> None:
    verification, count = verified(folder), REFERENCES[folder][1]
    assert verification.passed
    assert {
        comparison.output for comparison in verification.comparisons if comparison.status != "ok"
    } == UNPRODUCED.get(folder, set())
    assert sum(comparison.status == "ok" for comparison in verification.comparisons) == count


@pytest.mark.slow
@pytest.mark.parametrize("folder", REFERENCES)
def test_a_wrong_number_in_any_quantity_is_noticed(folder: str, tmp_path: Path) -> None:
    """In the first and the last place, of which padding leaves out one at most."""
    copy = Path(shutil.copytree(GOLDEN / folder, tmp_path / "reference"))
    with np.load(copy / "reference.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays.files}
    compared = {comparison.output for comparison in verified(folder).comparisons if comparison.status == "ok"}
    changed = sorted(compared & recorded.keys() - MASKS)
    for name in changed:
        values = recorded[name] = np.atleast_1d(recorded[name])
        worst = np.abs(values[np.isfinite(values)].astype(np.float64)).max(initial=0)
        for end in (0, -1):
            index = (end,) * values.ndim
            values[index] = values[index] + 0.01 * (1 + worst) if values.dtype.kind == "f" else 1 - values[index]
    recorded["something_else"] = np.zeros(1)
    np.savez(copy / "reference.npz", **recorded)
    status = {
        comparison.output: comparison.status
        for comparison in verify_reference(REFERENCES[folder][0], copy).comparisons
    }
    assert [name for name in changed if status[name] != "over"] == []
    assert status["something_else"] == "not compared"


built_once, function = cache(cache), Family.function
"""`built_once(build)` builds every size once: each list is compared with all sizes of its family."""


@pytest.mark.parametrize(("family", "file"), KEYS)
def test_the_network_of_a_released_size_has_the_recorded_tensors(
    family: str, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Family, "function", lambda declared, use: built_once(function(declared, use)))
    verification = verify_keys(family, file)
    assert verification.passed, verification.comparisons
    size = file.name.split(".")[1]
    assert not own_families()[family].checkpoints.sizes or verification.comparisons[0].output.endswith(
        f"keys of {size}"
    )


@pytest.mark.parametrize(
    ("folder", "twice", "share", "published"),
    [
        ("molmoact2", "", 1, 10.9),  # a fine-tune, in bfloat16
        ("groot", "", 0.5, 6.91),  # nvidia/GR00T-N1.7-3B, in bfloat16, with either name of the tied embeddings
        ("xvla", "model.vlm.language_model.shared.weight", 1, 3.52),  # 2toINF/X-VLA-WidowX, in float32
    ],
)
def test_the_tensors_take_as_many_bytes_as_the_published_file(
    folder: str, twice: str, share: float, published: float
) -> None:
    """In GB, as the pages of the hub round it. twice: a name of tied embeddings that a file leaves out."""
    content = json.loads(gzip.decompress((GOLDEN / folder / "real_keys.json.gz").read_bytes()))["keys"]
    assert not twice or twice in content
    tensor_bytes = [
        prod(header["shape"]) * BYTES[header["dtype"]] for name, header in content.items() if name != twice
    ]
    assert share * sum(tensor_bytes) / 1e9 == pytest.approx(published, abs=0.06 if published > 10 else 0.006)


@pytest.fixture(params=["pi0", "smolvla"])
def reference(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    """A golden reference a test may damage, as (family, folder)."""
    return request.param, Path(shutil.copytree(GOLDEN / request.param, tmp_path / request.param))


@pytest.mark.slow
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
    status_by_output = {c.output: c.status for c in compare(recorded, Outputs(produced))}
    assert status_by_output == {"a": "over", "b": "over", "c": "not compared"}


def test_a_reference_without_its_questions_is_refused(golden_vlm: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(golden_vlm / "paligemma", tmp_path / "golden"))
    (copy / "dims.json").unlink()
    with pytest.raises(UsageError, match=r"dims\.json is missing"):
        verify_reference("paligemma", copy)


def write_keys(source: Path, file: Path, gone: tuple[str, ...] = (), **added: object) -> Path:
    """Write a recorded list without some tensors and with others."""
    keys = json.loads(gzip.decompress(source.read_bytes()))["keys"]
    remaining = {name: entry for name, entry in keys.items() if name not in gone}
    file.write_text(json.dumps({"keys": remaining | added}), encoding="utf-8")
    return file


@pytest.mark.slow
def test_a_tensor_that_is_not_recorded_is_named(golden_vlm: Path, tmp_path: Path) -> None:
    gone = ("model.vision_tower.encoder.layer.3.lambda_1", "lm_head.weight")
    file = write_keys(golden_vlm / "internvl/real_keys.8B.json.gz", tmp_path / "keys.json", gone)
    verification = verify_keys("internvl", file)
    assert not verification.passed
    assert all(f"{name}: not recorded" in verification.comparisons[0].note for name in gone)


@pytest.mark.slow
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
