import json
from pathlib import Path

import pytest

from probe_kit.errors import CheckpointError
from probe_kit.models.spatialvla import SpatialVLAConfig
from tests.support.spatialvla_checkpoints import BINS, FIRST_ACTION, IMAGE, config_values


def test_a_short_text_config_is_completed_by_gemmas_defaults() -> None:
    """As the released files are: sizes that are Gemma-2's own are not written down."""
    short = {"hidden_size": 2304, "vocab_size": FIRST_ACTION + BINS["total"], "tie_word_embeddings": False}
    config = SpatialVLAConfig.from_json(config_values(text_config=short, projection_dim=2304))
    text = config.text
    assert (text.head_dim, text.num_key_value_heads, text.num_hidden_layers) == (256, 4, 26)
    assert (text.attn_logit_softcapping, text.final_logit_softcapping, text.rms_norm_eps) == (50, 30, 1e-6)


def test_the_old_name_of_the_rotary_base_is_understood() -> None:
    values = config_values()
    values["text_config"]["rope_theta"] = 5000.0
    assert SpatialVLAConfig.from_json(values).text.rope_parameters["rope_theta"] == 5000


def test_sizes_and_ids_come_from_the_file(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps(config_values(torch_dtype="bfloat16")), encoding="utf-8")
    config = SpatialVLAConfig.from_folder(tmp_path)
    assert (config.image_token, config.first_action, config.actions) == (IMAGE, FIRST_ACTION, BINS["total"])
    assert (config.side, config.patches, config.points, config.frequencies) == (42, 9, 2, 3)
    assert config.dtype == "bfloat16"
    assert config.own_action_embeddings


def test_a_model_may_see_no_depth() -> None:
    values = config_values(use_vision_zoe=False)
    del values["vision_zoe_config"], values["ego3d_patch_reso"]
    assert SpatialVLAConfig.from_json(values).depth is None


@pytest.mark.parametrize(
    "missing",
    ["image_token_index", "action_token_begin_idx", "vision_zoe_config", "ego3d_patch_reso", "text_config"],
)
def test_what_is_missing_is_named(missing: str) -> None:
    values = config_values()
    del values[missing]
    with pytest.raises(CheckpointError, match=missing):
        SpatialVLAConfig.from_json(values)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("model_type", "paligemma", "paligemma"),
        ("projection_dim", 48, "projection_dim 48"),
        ("spatial_token_num", 30, "action ids end at"),
        ("image_token_index", FIRST_ACTION, "is an action"),
        ("ego3d_patch_reso", 4, "4 points do not divide"),
        ("vision_config", {"model_type": "clip_vision_model"}, "clip_vision_model"),
    ],
)
def test_what_contradicts_is_refused_by_name(field: str, value: object, said: str) -> None:
    with pytest.raises(CheckpointError, match=said):
        SpatialVLAConfig.from_json({**config_values(), field: value})


def test_an_output_layer_tied_to_the_embeddings_is_refused_and_the_outer_flag_is_not_read() -> None:
    """The released outer config says tied; the language model's own says not."""
    values = config_values()
    assert values["tie_word_embeddings"]
    assert not SpatialVLAConfig.from_json(values).text.tie_word_embeddings
    values["text_config"]["tie_word_embeddings"] = True
    with pytest.raises(CheckpointError, match="ties the output layer"):
        SpatialVLAConfig.from_json(values)


def test_a_folder_without_a_config_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"config\.json is missing"):
        SpatialVLAConfig.from_folder(tmp_path)
