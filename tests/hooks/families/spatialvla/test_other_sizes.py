"""A reference of other sizes, which is recorded here from the network itself, is reproduced too."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from probe_kit.hooks.families.spatialvla.adapter import load_checkpoint
from probe_kit.hooks.verify import verify_reference
from probe_kit.models.spatialvla import PictureSettings, depth_input, prepare_picture
from probe_kit.models.spatialvla_actions import ActionBins
from tests.support.spatialvla_checkpoints import FIRST_ACTION, IMAGE, config_values, write_checkpoint

OTHER_BINS = {
    "translation": {"theta_bins": 2, "phi_bins": 3, "r_bins": 3},
    "rotation": {"roll_bins": 3, "pitch_bins": 2, "yaw_bins": 2},
    "gripper": 2,
    "total": 32,
}


@pytest.mark.slow
@pytest.mark.parametrize("own_camera", [True, False])
def test_a_reference_of_other_sizes_is_compared_in_every_output(tmp_path: Path, own_camera: bool) -> None:
    """Other patches, points, bins, chunk, tokens and padding, recorded from the network itself.

    The original takes the data set's camera, which belongs to pictures of another size than the recorded one.
    """
    vision = {**config_values()["vision_config"], "image_size": 64, "patch_size": 16, "num_hidden_layers": 3}
    write_checkpoint(
        tmp_path / "checkpoint",
        shards=1,
        bins=OTHER_BINS,
        processor={"action_chunk_size": 2},
        tokenizer=False,
        vision_config=vision,
        ego3d_patch_reso=4,
        n_freqs=5,
    )
    recorded = _record(tmp_path / "checkpoint", own_camera)
    np.savez(tmp_path / "reference.npz", **recorded)
    verification = verify_reference("spatialvla", tmp_path)
    assert {c.output: c.status for c in verification.comparisons} == dict.fromkeys(
        set(recorded)
        - {"image_uint8", "intrinsic_raw", "input_ids", "batch_input_ids", "batch_attention_mask", "forced_ids"}
        - {"batch_pixel_values", "batch_intrinsic", "tok_actions"},
        "ok",
    )


@torch.inference_mode()
def _record(checkpoint: Path, own_camera: bool) -> dict[str, NDArray[np.generic]]:
    loaded = load_checkpoint(str(checkpoint), "cpu", None, random_weights=False)
    network, config = loaded.network, loaded.config
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (50, 80, 3), dtype=np.uint8)
    camera, width, height = np.array([[90, 0, 41], [0, 80, 26], [0, 0, 1]], np.float32), 80, 50
    if not own_camera:
        known = loaded.processor["intrinsic_config"]["default"]
        camera, width, height = np.array(known["intrinsic"], np.float32), known["width"], known["height"]
    pixels = torch.from_numpy(prepare_picture(image, PictureSettings(config.side)))[None]
    scaled = torch.from_numpy((camera * [[64 / width], [64 / height], [1]]).astype(np.float32))
    seen = network.look(pixels, scaled)
    assert seen.depth is not None
    assert seen.points is not None
    rows = [[IMAGE] * config.patches + [2, 7, 8, 9, 4], [IMAGE] * config.patches + [2, 9, 4, 0, 0]]
    ids = torch.tensor(rows)
    mask = torch.tensor([[True] * len(rows[0]), [True] * (len(rows[0]) - 2) + [False] * 2])
    both = network.look(pixels.repeat(2, 1, 1, 1), scaled.repeat(2, 1, 1), vote=True)
    output = network(network.embed(ids, both.features), mask)
    forced = np.array([FIRST_ACTION + 5, FIRST_ACTION + 20])
    decoded = network.decode(ids[:1], mask[:1], seen.features, 6)
    fed = network.decode(ids[:1], mask[:1], seen.features, 3, fed=torch.from_numpy(forced)[None])
    bins = ActionBins.of(loaded.processor, FIRST_ACTION, OTHER_BINS["total"], "test")
    actions = rng.uniform(-1, 1, (5, 7))
    statistics = loaded.processor["statistics"]["bridge_orig/1.0.0"]["action"]
    low, high = (np.array(statistics[name]) for name in ("q01", "q99"))
    values = bins.values(bins.ids(actions)[:2])
    return {
        "image_uint8": image,
        "intrinsic_raw": camera,
        "input_ids": ids[:1].numpy(),
        "forced_ids": forced,
        "batch_input_ids": ids.numpy(),
        "batch_attention_mask": mask.numpy().astype(np.int64),
        "batch_pixel_values": pixels.repeat(2, 1, 1, 1).numpy(),
        "batch_intrinsic": scaled.repeat(2, 1, 1).numpy(),
        "pixel_values": pixels.numpy(),
        "intrinsic": scaled.numpy(),
        "zoe_pixel_values_sub": depth_input(pixels)[..., ::12, ::12].numpy(),
        "depth_raw_sub": seen.depth.raw[..., ::6, ::6].numpy(),
        "depth": seen.depth.metres.numpy(),
        "xyz": seen.points.numpy(),
        "image_features": (seen.features / 32**0.5).numpy(),
        "hidden_states": torch.stack(output.hidden_states)[:, :1].numpy(),
        "logits": output.logits[:1].numpy(),
        "batch_hidden_states": torch.stack(output.hidden_states).numpy(),
        "batch_logits": output.logits.numpy(),
        "generated_ids": decoded.ids[0].numpy(),
        "generated_step_logits": decoded.logits[0].numpy(),
        "forced_step_logits": fed.logits[0].numpy(),
        "tok_actions": actions,
        "tok_ids": bins.ids(actions),
        "decode_table": bins.values(np.repeat(np.arange(config.text.vocab_size)[:, None], 3, axis=1)),
        "actions_from_tok_ids": np.where(statistics["mask"], (values + 1) / 2 * (high - low) + low, values),
        "action_ids_from_tok": bins.ids(actions)[:2],
    }


def test_the_record_of_the_test_itself_is_in_the_layout_of_the_golden_one(golden_spatialvla: Path) -> None:
    """So that the sizes above differ, and nothing else."""
    ours = config_values()
    theirs = json.loads((golden_spatialvla / "checkpoint" / "config.json").read_text(encoding="utf-8"))
    assert set(ours) - set(theirs) == set()
    for part in ("text_config", "vision_config", "vision_zoe_config"):
        assert set(ours[part]) - set(theirs[part]) == set()
