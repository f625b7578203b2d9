""""""

import json
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from probe_kit.errors import CheckpointError, UsageError, WeightsError
from probe_kit.hooks import Observation, Site, capture, load_policy
from probe_kit.hooks.capturing.capture_context import edit
from probe_kit.hooks.contract.sites import first_of
from probe_kit.hooks.families.internvla import ActionUnits
from probe_kit.hooks.families.internvla.adapter import InternVLA, load_internvla
from probe_kit.hooks.families.internvla.checkpoint import RELEASED_STEP, convert, find_parts
from probe_kit.hooks.families.internvla.network import dino_pixels
from tests.hooks.families.internvla.checkpoints import statistics, write_checkpoint, write_vlm


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("internvla"))


@pytest.fixture(scope="module")
def loaded(run: Path) -> InternVLA:
    return load_internvla(str(run), steps=5, unnorm_key="bridge_dataset")


def test_all_that_acts_passes_through_the_end_of_the_bridge(loaded: InternVLA, observation: Observation) -> None:
    """What its declaration advises in place of a memory: of the picture, DINOv2's part passes the backbone by."""
    other = replace(observation, image=255 - observation.image)
    ends = [loaded.streams[name].sites()[-1] for name in ("backbone", "bridge")]
    with capture(loaded, ends) as donor:
        expected = loaded.act([other], [0])
    plain = loaded.act([observation], [0])
    with edit(loaded, {ends[1]: lambda _: donor[ends[1]]}):
        np.testing.assert_array_equal(loaded.act([observation], [0]), expected)
    with edit(loaded, {ends[0]: lambda _: donor[ends[0]]}):
        without_dino = loaded.act([observation], [0])
    assert np.abs(without_dino - expected).max() > 0
    assert np.abs(expected - plain).max() > 0


# -- captured sites ------------------------------------------------------------------------------------------


def test_guidances_halves_are_told_apart(loaded: InternVLA, observation: Observation) -> None:
    """Both start from the same actions; what stands before them differs in the condition alone."""
    first = [Site(name, 0, "residual", 0) for name in ("expert", "expert_unconditional")]
    with capture(loaded, first) as activations:
        loaded.act([observation], [0])
    ours, without = (activations[site][0] for site in first)
    roles = loaded.roles([observation])["expert"][0]
    actions = torch.from_numpy(roles.mask("action"))
    torch.testing.assert_close(ours[actions], without[actions], rtol=0, atol=0)
    assert (ours[~actions] - without[~actions]).abs().max() > 1e-2
    other = Observation(255 - observation.image, observation.state, "Take it away")
    with capture(loaded, first) as changed:
        loaded.act([other], [0])
    assert torch.equal(changed[first[1]][0], without)
    assert (changed[first[0]][0][~actions] - ours[~actions]).abs().max() > 1e-3


def test_the_half_without_condition_is_no_default_of_anything(loaded: InternVLA) -> None:
    assert not loaded.streams["expert_unconditional"].probed
    assert first_of("action", loaded.streams.values()) == "expert"
    assert first_of("bridge", loaded.streams.values()) == "bridge"


def test_without_guidance_there_is_no_such_half(run: Path) -> None:
    policy = load_internvla(str(run), guidance=1.0, unnorm_key="bridge_dataset")
    assert list(policy.streams) == ["backbone", "bridge", "expert"]


def test_an_edit_of_the_queries_leaves_the_parameter_as_it_was(
    loaded: InternVLA, observation: Observation
) -> None:
    before = loaded.network.layer_qformer.query_tokens.clone()
    plain = loaded.act([observation], [0])
    with edit(loaded, {Site("bridge", 0): torch.zeros_like}):
        changed = loaded.act([observation], [0])
    assert np.abs(changed - plain).max() > 0
    assert torch.equal(loaded.network.layer_qformer.query_tokens, before)
    np.testing.assert_array_equal(loaded.act([observation], [0]), plain)


def test_an_edit_of_one_half_leaves_the_other_alone(loaded: InternVLA, observation: Observation) -> None:
    site, other = Site("expert", 1, "residual", 0), Site("expert_unconditional", 1, "residual", 0)
    with capture(loaded, [other]) as plain:
        loaded.act([observation], [0])
    with edit(loaded, {site: torch.zeros_like}), capture(loaded, [site, other]) as edited:
        loaded.act([observation], [0])
    assert (edited[site] == 0).all()
    assert torch.equal(edited[other], plain[other])


def test_roles_follow_the_picture_and_the_chat(loaded: InternVLA, observation: Observation) -> None:
    roles = loaded.roles([observation])
    assert roles["backbone"][0].mask("image.primary").sum() == 64
    assert roles["backbone"][0].mask("special").sum() == 7
    assert [span.role for span in roles["bridge"][0].spans] == ["query"]
    assert [(span.role, span.stop - span.start) for span in roles["expert"][0].spans] == [
        ("condition", 6), ("action", 4),
    ]  # fmt: skip
    vision = [Site("vision", 2), Site("vision_dino", 2)]
    with capture(loaded, vision) as activations:
        loaded.act([observation], [0])
    assert activations[vision[0]].shape == (1, 256, 32)
    assert activations[vision[1]].shape == (1, 17, 24)


def test_a_picture_that_is_no_whole_patches_is_resized_with_pil_for_qwen_and_not_for_dino(
    tmp_path: Path, observation: Observation
) -> None:
    policy = load_internvla(str(write_checkpoint(tmp_path, side=200)), unnorm_key="bridge_dataset")
    picture = policy.look(observation)
    assert picture.shape == (200, 200, 3)
    by_hand = np.array(Image.fromarray(picture).resize((196, 196), Image.Resampling.BICUBIC))
    np.testing.assert_array_equal(policy.patched_picture(observation), by_hand)
    expected, grid = policy.pictures.patches([by_hand])
    model_inputs = policy.inputs([observation])
    assert torch.equal(model_inputs.pixel_values, expected)
    assert torch.equal(model_inputs.grid, grid)
    assert torch.equal(policy.views([observation])[0], dino_pixels(picture, 56))
    assert policy.roles([observation])["backbone"][0].mask("image").sum() == 49
    assert np.isfinite(policy.act([observation], [0])).all()


# -- acting ----------------------------------------------------------------------------------------------------


def test_actions_are_in_the_units_of_the_data_set(loaded: InternVLA, observation: Observation) -> None:
    actions = loaded.act([observation], [0])
    assert actions.shape == (1, 4, 7)
    assert set(np.unique(actions[..., 6])) <= {0.0, 1.0}
    assert ((actions[..., :6] >= -0.04 - 1e-6) & (actions[..., :6] <= 0.05 + 1e-6)).all()
    assert (loaded.card.chunk, loaded.card.execute, loaded.card.batch) == (4, 1, 1)


def test_options_are_part_of_the_identity(run: Path, loaded: InternVLA) -> None:
    other = load_policy("internvla-m1", str(run), unnorm_key="fractal20220817_data", steps="10", guidance="2")
    changed = {name for name, value in loaded.card.settings.items() if other.card.settings[name] != value}
    assert changed == {"unnorm_key", "action_statistics", "steps", "guidance"}
    assert {name for name in loaded.card.settings if name.startswith("file ")} >= {
        "file config.yaml", "file dataset_statistics.json", "file dims.json", "file vlm/config.json",
        "file vlm/tokenizer.json", "file vlm/preprocessor_config.json",
    }  # fmt: skip
    with pytest.raises(UsageError, match="bridge_dataset, fractal20220817_data"):
        load_internvla(str(run), unnorm_key="franka")
    with pytest.raises(UsageError, match="60 DDIM steps"):
        load_internvla(str(run), steps=60, unnorm_key="bridge_dataset")


def test_without_statistics_it_says_so_and_refuses_to_act(
    run: Path, tmp_path: Path, observation: Observation
) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    (copy / "dataset_statistics.json").unlink()
    policy = load_internvla(str(copy), unnorm_key="bridge_dataset")
    assert "cannot act" in policy.card.notes[0]
    with pytest.raises(CheckpointError, match=r"dataset_statistics\.json"):
        policy.act([observation], [0])


def test_statistics_of_other_arms_are_refused(run: Path, tmp_path: Path, observation: Observation) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    two = {"both_arms": {"action": {"q01": [0.0] * 14, "q99": [1.0] * 14}}}
    (copy / "dataset_statistics.json").write_text(json.dumps(two), encoding="utf-8")
    with pytest.raises(CheckpointError, match="14 dimensions"):
        load_internvla(str(copy)).act([observation], [0])


NAME = "steps_7_pytorch_model.pt"


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("internvla"))


def test_the_run_its_folder_of_weights_and_the_file_are_the_same_checkpoint(run_folder: Path) -> None:
    places = (run_folder, run_folder / "checkpoints", run_folder / "checkpoints" / NAME)
    parts = [find_parts(str(path), None) for path in places]
    assert {part.weights for part in parts} == {run_folder / "checkpoints" / NAME}
    assert {part.run for part in parts} == {run_folder}
    assert {part.vlm for part in parts} == {run_folder.parent / "vlm"}


def test_of_several_weights_one_has_to_be_named(run_folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run_folder, tmp_path / "run"))
    shutil.copy(copy / "checkpoints" / NAME, copy / "checkpoints" / "steps_8_pytorch_model.pt")
    with pytest.raises(CheckpointError, match=r"steps_7.*steps_8.*-M weights=FILE.*--checkpoint"):
        find_parts(str(copy), None)
    assert find_parts(str(copy), None, "steps_8_pytorch_model.pt").weights.name == "steps_8_pytorch_model.pt"
    with pytest.raises(CheckpointError, match=r"no weights 'steps_9.pt'; choose .* steps_7.*steps_8"):
        find_parts(str(copy), None, "steps_9.pt")
    shutil.copy(copy / "checkpoints" / NAME, copy / "checkpoints" / RELEASED_STEP)
    assert find_parts(str(copy), None).weights.name == RELEASED_STEP
    assert find_parts(str(copy), None, unread=True).weights == copy
    assert find_parts(str(copy / "checkpoints" / NAME), None).weights.name == NAME
    shutil.rmtree(copy / "checkpoints")
    with pytest.raises(CheckpointError, match="no weights"):
        find_parts(str(copy), None)


def test_a_runs_configuration_may_be_json(run_folder: Path, tmp_path: Path, observation: Observation) -> None:
    copy = Path(shutil.copytree(run_folder, tmp_path / "run"))
    values = yaml.safe_load((copy / "config.yaml").read_text(encoding="utf-8"))
    (copy / "config.yaml").unlink()
    (copy / "dims.json").rename(copy / "aside")
    with pytest.raises(CheckpointError, match=r"config\.yaml or config\.json of a run is missing"):
        find_parts(str(copy), None)
    (copy / "aside").rename(copy / "dims.json")
    (copy / "config.json").write_text(json.dumps(values), encoding="utf-8")
    original, other = (
        load_internvla(str(folder), steps=5, unnorm_key="bridge_dataset") for folder in (run_folder, copy)
    )
    np.testing.assert_array_equal(original.act([observation], [3]), other.act([observation], [3]))
    assert f"weights of {NAME}" in other.card.notes


def test_of_the_hub_one_step_is_downloaded(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the hub does it: only files that match a pattern come."""
    hub = Path(shutil.copytree(run_folder, tmp_path / "hub"))
    steps = [f"steps_{number}_pytorch_model.pt" for number in (10000, 30000, 50000)]
    for name in steps:
        shutil.copy(hub / "checkpoints" / NAME, hub / "checkpoints" / name)
    (hub / "checkpoints" / NAME).unlink()
    cache = tmp_path / "cache"

    def download(_name: str, allow_patterns: list[str], **_: object) -> str:
        files = (file for file in hub.rglob("*") if file.is_file())
        for file in files:
            path = file.relative_to(hub).as_posix()
            if any(fnmatch(path, pattern) for pattern in allow_patterns):
                (cache / path).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(file, cache / path)
        return str(cache)

    listed = [file.relative_to(hub).as_posix() for file in hub.rglob("*") if file.is_file()]
    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    monkeypatch.setattr("huggingface_hub.HfApi.list_repo_files", lambda _, _name, **_keywords: listed)
    monkeypatch.setattr("probe_kit.hooks.checkpoints.checkpoint.unreachable", lambda: "")
    assert find_parts("some/run", None, unread=True).weights == cache
    assert not list(cache.rglob("*.pt"))
    assert find_parts("some/run", None).weights == cache / "checkpoints" / RELEASED_STEP
    assert [file.name for file in cache.rglob("*.pt")] == [RELEASED_STEP]
    find_parts("some/run", None, steps[0])
    assert sorted(file.name for file in cache.rglob("*.pt")) == sorted([steps[0], RELEASED_STEP])


def test_a_vision_language_model_can_be_named_and_has_to_be_one(run_folder: Path, tmp_path: Path) -> None:
    other = write_vlm(tmp_path / "other")
    assert find_parts(str(run_folder), str(other)).vlm == other
    (other / "config.json").write_text(json.dumps({"model_type": "qwen3_vl"}), encoding="utf-8")
    with pytest.raises(CheckpointError, match="qwen2_5_vl"):
        find_parts(str(run_folder), str(other))


class _Harm:
    """Runs a command when it is unpickled the unsafe way."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return eval, (f"open({str(self.trace)!r}, 'w').close()",)


def test_a_file_that_would_run_code_runs_none(run_folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run_folder, tmp_path / "run"))
    trace = tmp_path / "trace"
    torch.save({"weight": _Harm(trace)}, copy / "checkpoints" / NAME)
    with pytest.raises(WeightsError, match="unsafe"):
        load_internvla(str(copy), unnorm_key="bridge_dataset")
    (copy / "checkpoints" / NAME).write_bytes(pickle.dumps(_Harm(trace), protocol=2))
    with pytest.raises(WeightsError, match="unsafe"):
        load_internvla(str(copy), unnorm_key="bridge_dataset")
    assert not trace.exists()


def test_missing_and_extra_tensors_are_named(run_folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run_folder, tmp_path / "run"))
    file = copy / "checkpoints" / NAME
    state = torch.load(file, weights_only=True)
    state["dino_pro.other"] = state.pop("dino_pro.bias")
    torch.save(state, file)
    with pytest.raises(WeightsError, match=r"missing.*dino_pro\.bias"):
        load_internvla(str(copy), unnorm_key="bridge_dataset")


def test_the_stored_precision_is_kept(run_folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run_folder, tmp_path / "run"))
    file = copy / "checkpoints" / NAME
    torch.save({name: t.to(torch.bfloat16) for name, t in torch.load(file, weights_only=True).items()}, file)
    assert load_internvla(str(run_folder), unnorm_key="bridge_dataset").card.dtype == "float32"
    assert load_internvla(str(copy), unnorm_key="bridge_dataset").card.dtype == "bfloat16"
    assert load_internvla(str(copy), dtype="float32", unnorm_key="bridge_dataset").card.dtype == "float32"


@pytest.mark.slow
def test_a_converted_folder_is_whole_and_has_the_same_hash_and_actions(
    run_folder: Path, tmp_path: Path, observation: Observation
) -> None:
    original = load_internvla(str(run_folder), steps=5, unnorm_key="bridge_dataset")
    assert convert(str(run_folder), tmp_path / "out") == original.card.weights_sha256
    copy = load_internvla(str(tmp_path / "out"), steps=5, unnorm_key="bridge_dataset")
    assert copy.parts.vlm == copy.parts.run == tmp_path / "out"
    assert copy.card.weights_sha256 == original.card.weights_sha256
    np.testing.assert_array_equal(copy.act([observation], [3]), original.act([observation], [3]))
    with pytest.raises(UsageError, match="exists"):
        convert(str(run_folder), tmp_path / "out")


@pytest.mark.slow
def test_the_converter_is_a_command(run_folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "probe_kit.hooks.families.internvla.checkpoint"]
    completed = subprocess.run(
        [*command, str(run_folder), str(tmp_path / "out")], capture_output=True, encoding="utf-8", check=False
    )
    assert completed.returncode == 0, completed.stderr
    assert len(completed.stdout.strip()) == 64
    refused = subprocess.run(
        [*command, str(tmp_path / "no"), "x"], capture_output=True, encoding="utf-8", check=False
    )
    assert refused.returncode != 0
    assert "does not exist" in refused.stderr
    assert "Traceback" not in refused.stderr


LOW, HIGH = [-1.0] * 6 + [0.0], [3.0] * 6 + [1.0]


def test_values_are_clipped_and_stretched_and_the_gripper_is_cut_at_a_half() -> None:
    units = ActionUnits.of("x", {"q01": LOW, "q99": HIGH, "mask": [True] * 6 + [False]})
    normalised = np.array([[-2, -1, 0, 0.5, 1, 5, 0.5], [0, 0, 0, 0, 0, 0, 0.49]], np.float32)
    np.testing.assert_allclose(units.restore(normalised)[0], [-1, -1, 1, 2, 3, 3, 1])
    np.testing.assert_allclose(units.restore(normalised)[1, 6], 0)


def test_a_masked_in_gripper_is_stretched_after_it_was_cut() -> None:
    units = ActionUnits.of("x", {"q01": LOW, "q99": HIGH})
    assert units.restore(np.full((1, 7), 0.2, np.float32))[0, 6] == 0.5
    assert units.restore(np.full((1, 7), 0.7, np.float32))[0, 6] == 1.0


def test_the_only_set_needs_no_name_and_several_have_to_be_chosen_from() -> None:
    with pytest.raises(UsageError, match="with -M unnorm_key=NAME: bridge_dataset, fractal"):
        ActionUnits.choose(statistics(), None)
    assert ActionUnits.choose({"franka": statistics()["bridge_dataset"]}, None).key == "franka"
    two = {"franka": {}, "google": {}}
    with pytest.raises(UsageError, match="franka, google"):
        ActionUnits.choose(two, None)
    with pytest.raises(UsageError, match="Did you mean franka"):
        ActionUnits.choose(two, "frank")


def test_bad_statistics_are_named() -> None:
    with pytest.raises(CheckpointError, match="q99"):
        ActionUnits.choose({"franka": {"action": {"q01": [0.0]}}}, None)
    with pytest.raises(CheckpointError, match="finite"):
        ActionUnits.of("x", {"q01": [0.0, np.inf], "q99": [1.0, 1.0]})
    with pytest.raises(CheckpointError, match=r"dataset_statistics\.json"):
        ActionUnits.choose({}, None)
