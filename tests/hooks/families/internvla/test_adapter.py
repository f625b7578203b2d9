import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks import Observation, Site, capture, load_policy
from probe_kit.hooks.capturing.capture_context import edit
from probe_kit.hooks.contract.sites import first_of
from probe_kit.hooks.families.internvla.adapter import InternVLA, load_internvla
from probe_kit.models.internvla import dino_pixels
from tests.support.internvla_checkpoints import write_checkpoint


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
    with capture(loaded, first) as tape:
        loaded.act([observation], [0])
    ours, without = (tape[site][0] for site in first)
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
    with capture(loaded, vision) as tape:
        loaded.act([observation], [0])
    assert tape[vision[0]].shape == (1, 256, 32)
    assert tape[vision[1]].shape == (1, 17, 24)


def test_a_picture_that_is_no_whole_patches_is_resized_with_pil_for_qwen_and_not_for_dino(
    tmp_path: Path, observation: Observation
) -> None:
    policy = load_internvla(str(write_checkpoint(tmp_path, side=200)), unnorm_key="bridge_dataset")
    picture = policy.look(observation)
    assert picture.shape == (200, 200, 3)
    by_hand = np.array(Image.fromarray(picture).resize((196, 196), Image.Resampling.BICUBIC))
    np.testing.assert_array_equal(policy.patched_picture(observation), by_hand)
    expected, grid = policy.pictures.patches([by_hand])
    seen = policy.inputs([observation])
    assert torch.equal(seen.pixel_values, expected)
    assert torch.equal(seen.grid, grid)
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
