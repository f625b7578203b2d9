"""From the raw picture and state to metres as lerobot does it, and no step of its pipelines passes unread."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.pi0_fast import modeling_pi0_fast
from lerobot.policies.pi05 import modeling_pi05
from safetensors.torch import load_file, save_file

from probe_kit.errors import CheckpointError, InstructionError
from probe_kit.hooks import Observation
from probe_kit.hooks.conformance.subject import examples_for
from probe_kit.hooks.families.pi0.adapter import Pi05
from probe_kit.hooks.families.pi0_fast.adapter import Pi0Fast, Pi0FastSize, sized
from probe_kit.models.pi0 import Pi0Size, resized
from tests.support.lerobot_pipelines import changed, raw, save_pipelines, without_hub
from tests.support.pi0_fast_checkpoints import fast_processor, write_pi0_fast
from tests.support.pi05_checkpoints import HIGH, LOW, write_pi05

CAMERAS = ("base", "wrist")


@pytest.fixture(scope="module")
def patch() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, patch: pytest.MonkeyPatch) -> Path:
    folder = write_pi05(tmp_path_factory.mktemp("pi05"), cameras=CAMERAS, empty_cameras=1)
    without_hub(folder, patch)
    return folder


def seen() -> list[Observation]:
    """Two observations with states that lie beyond the quantiles too."""
    rng, texts = np.random.default_rng(0), ("Put_the cube\non the star", "put the cube on the red shape")
    return [
        Observation(
            rng.integers(0, 256, (24, 40, 3), np.uint8),
            (LOW + (HIGH - LOW) * rng.uniform(-0.1, 1.1, LOW.shape)).astype(np.float32),
            text,
            cameras={"wrist": rng.integers(0, 256, (24, 40, 3), np.uint8)},
        )
        for text in texts
    ]


@pytest.mark.parametrize(
    ("mode", "dtype"),
    [
        ("QUANTILES", "bfloat16"),
        ("QUANTILES", "float32"),
        ("QUANTILE10", "float32"),
        ("MEAN_STD", "float32"),
        ("MIN_MAX", "float32"),
    ],
)
def test_pi05_acts_as_lerobots_own_loading_processors_and_policy_bit_for_bit(
    folder: Path, mode: str, dtype: str
) -> None:
    modes = {"VISUAL": "IDENTITY", "STATE": mode, "ACTION": mode}
    before, behind = save_pipelines(folder, normalization_mapping=modes, dtype=dtype)
    with resized(modeling_pi05, Pi0Size.from_file(folder / "dims.json")):
        theirs = modeling_pi05.PI05Policy.from_pretrained(folder).eval()
    every = Pi05.load(str(folder))
    for shown in (CAMERAS, CAMERAS[:1]):
        ours = every.showing(shown)
        for seed, one in enumerate(seen()):
            pictures = {"base": one.image, **one.cameras}
            packed = before(raw(one, {name: pictures[name] for name in shown}))
            chunk = theirs.predict_action_chunk(packed, noise=ours.noise([seed]))
            metres = torch.stack([behind(own) for own in chunk.float().unbind(1)], 1)
            np.testing.assert_array_equal(ours.act([one], [seed]), metres.numpy())


def test_pi0_fast_acts_as_lerobots_own_select_action(
    golden_pi0_fast: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trained weights: whole chunks, of which lerobot hands out one action after the other."""
    folder = Path(shutil.copytree(golden_pi0_fast / "checkpoint", tmp_path / "checkpoint"))
    ours = _fast_acts_as_lerobot(folder, monkeypatch)
    assert ours.flagged is not None
    assert not ours.flagged.any()


@pytest.mark.filterwarnings("ignore:the model put out tokens")
def test_pi0_fast_decodes_broken_chunks_as_lerobot_does_and_flags_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_pi0_fast(tmp_path, cameras=CAMERAS, empty_cameras=1, validate_action_token_prefix=False)
    ours = _fast_acts_as_lerobot(folder, monkeypatch)
    assert ours.flagged is not None
    assert ours.flagged.all()


def _fast_acts_as_lerobot(folder: Path, patch: pytest.MonkeyPatch) -> Any:
    without_hub(folder, patch)
    before, behind = save_pipelines(folder)
    ours, fast = Pi0Fast.load(str(folder)), fast_processor(folder / "fast")
    for name, own in (("AutoTokenizer", ours.tokenizer), ("AutoProcessor", fast)):
        patch.setattr(modeling_pi0_fast, name, SimpleNamespace(from_pretrained=lambda *_, own=own, **__: own))
    with sized(Pi0FastSize.from_file(folder / "dims.json"), ours.config):
        theirs = modeling_pi0_fast.PI0FastPolicy.from_pretrained(folder).eval()
    for one in seen():
        packed = before(raw(one, {"base": one.image}))
        theirs.reset()
        actions = [behind(theirs.select_action(packed)).numpy() for _ in range(4)]
        np.testing.assert_array_equal(ours.act([one], [0]), np.stack(actions, 1))
    return ours


def _inserted(steps: list[dict[str, Any]]) -> None:
    steps.insert(1, {"registry_name": "vla_jepa_binarize_gripper", "config": {}})


def _of_a_class(steps: list[dict[str, Any]]) -> None:
    steps.insert(1, {"class": "somewhere.Step", "config": {}})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_inserted, "vla_jepa_binarize_gripper"),
        (_of_a_class, r"somewhere\.Step"),
        (changed("tokenizer_processor", padding_side="left"), "padding_side: 'left'"),
    ],
)
def test_a_step_that_would_change_numbers_unread_is_refused_by_name(
    folder: Path, change: Callable[[list[dict[str, Any]]], None], message: str
) -> None:
    with suppress(KeyError, ImportError, ValueError, TypeError):  # lerobot may not know it either
        save_pipelines(folder, change)
    with pytest.raises(CheckpointError, match=message):
        Pi05.load(str(folder))


def test_an_unknown_step_behind_the_policy_forbids_to_act_and_not_to_capture(folder: Path) -> None:
    save_pipelines(folder)
    path = folder / "policy_postprocessor.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    _inserted(content["steps"])
    path.write_text(json.dumps(content), encoding="utf-8")
    policy = Pi05.load(str(folder))
    seen = examples_for(policy, "put the cube on the star")
    with pytest.raises(CheckpointError, match="vla_jepa_binarize_gripper"):
        policy.act(seen, [0])
    assert "vla_jepa_binarize_gripper" in str(policy.embodiment_mismatch())
    assert policy.infer_without_acting(seen, [0]).shape == (1, 4, 7)


def test_pictures_that_lerobot_would_normalise_are_refused(folder: Path) -> None:
    save_pipelines(
        folder, normalization_mapping={"VISUAL": "MEAN_STD", "STATE": "QUANTILES", "ACTION": "QUANTILES"}
    )
    assert Pi05.load(str(folder)).embodiment_mismatch() is None  # without statistics of pictures lerobot does not
    (file,) = folder.glob("policy_preprocessor_*.safetensors")
    tensors = load_file(file)
    pictures = {f"observation.images.base.{name}": torch.full((3, 1, 1), 0.5) for name in ("mean", "std")}
    save_file(tensors | pictures, file)
    with pytest.raises(CheckpointError, match=r"normalises observation\.images\.base by statistics"):
        Pi05.load(str(folder))


@pytest.mark.parametrize("where", ["configuration", "relative_actions_processor", "absolute_actions_processor"])
def test_changes_relative_to_the_state_are_no_actions_of_this_arm(folder: Path, where: str) -> None:
    """lerobot adds the state; a delta of the end effector without it would be another motion."""
    save_pipelines(folder, None if where == "configuration" else changed(where, enabled=True),
                   use_relative_actions=where == "configuration")  # fmt: skip
    policy = Pi05.load(str(folder))
    save_pipelines(folder, use_relative_actions=False)  # what was read at loading counts
    assert policy.predicts_relative
    assert any("relative to the state" in note for note in policy.card.notes)
    (one,) = examples_for(policy, "put the cube on the star")
    with pytest.raises(CheckpointError, match="relative to the state"):
        policy.act([one], [0])


def test_the_length_of_the_text_is_that_of_the_saved_step(folder: Path) -> None:
    save_pipelines(folder, changed("tokenizer_processor", max_length=20))
    policy = Pi05.load(str(folder))
    (one,) = examples_for(policy, "put the cube on the star")
    with pytest.raises(InstructionError, match="this checkpoint reads 20"):
        policy.act([one], [0])


@pytest.mark.parametrize("numbers", [1, 5])
def test_statistics_of_another_width_are_no_units(folder: Path, numbers: int) -> None:
    """One number would be spread over all of them."""
    save_pipelines(folder)
    (file,) = folder.glob("policy_postprocessor_*.safetensors")
    tensors = load_file(file)
    save_file({name: own[:numbers] if name.startswith("action") else own for name, own in tensors.items()}, file)
    assert f"statistics of shape ({numbers},)" in str(Pi05.load(str(folder)).embodiment_mismatch())


def test_a_state_that_the_pipeline_leaves_out_is_read_as_it_is(folder: Path) -> None:
    save_pipelines(folder, changed("normalizer_processor", normalize_observation_keys=[]))
    policy = Pi05.load(str(folder))
    assert policy.state_units.mode == "IDENTITY"
    assert policy.action_units.mode == "QUANTILES"
