import json
from pathlib import Path

import pytest
import torch

from probe_kit.errors import CheckpointError
from probe_kit.models.magma import MagmaConfig, build_magma
from tests.support.magma_checkpoints import IDS, config_values


def test_everything_comes_from_the_file() -> None:
    config = MagmaConfig.from_json(config_values())
    assert (config.text.hidden_size, config.text.rms_norm_eps) == (64, 1e-5)
    assert config.text.rope_parameters["rope_theta"] == 500000.0
    assert (config.image_token, config.base_vocabulary, config.dtype) == (IDS["<image>"], 512, "float32")
    assert config.image_start_end
    assert (config.vision.trunk, config.vision.base, config.vision.crops) == ("convnext_xxlarge", 64, 4)


def test_a_file_without_text_config_has_the_same_fields_at_its_top() -> None:
    values = config_values()
    flat = {**values["text_config"], **{name: value for name, value in values.items() if name != "text_config"}}
    ours, theirs = MagmaConfig.from_json(flat).text, MagmaConfig.from_json(values).text
    assert (ours.hidden_size, ours.num_key_value_heads, ours.rope_parameters, ours.vocab_size) == (
        theirs.hidden_size,
        theirs.num_key_value_heads,
        theirs.rope_parameters,
        theirs.vocab_size,
    )


@pytest.mark.parametrize("name", ["mlp2x_gelu", "mlp2x_gelu_segtokv2"])
def test_older_names_of_the_projector_mean_the_same_modules(name: str) -> None:
    assert MagmaConfig.from_json(config_values(vision={"mm_projector_type": name})).vision.projector_layers == 2


@pytest.mark.parametrize(
    ("part", "field", "value"),
    [
        ("vision", "vision_backbone", "convnextbase"),
        ("vision", "mm_projector_type", "linear"),
        ("vision", "img_anyres_strategy", "tile"),
        ("vision", "vision_feature_layer", "res4"),
        ("vision", "hidden_size", 96),
        ("text", "model_type", "mistral"),
    ],
)
def test_what_is_unknown_or_contradicts_is_refused_by_name(part: str, field: str, value: object) -> None:
    with pytest.raises(CheckpointError, match=str(value)):
        MagmaConfig.from_json(config_values(**{part: {field: value}}))


def test_another_model_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="'llava'"):
        MagmaConfig.from_json(config_values(model_type="llava"))
    with pytest.raises(CheckpointError, match=r"config\.json is missing"):
        MagmaConfig.from_folder(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "magma"}), encoding="utf-8")
    with pytest.raises(CheckpointError, match="vision_config"):
        MagmaConfig.from_folder(tmp_path)


def test_a_projector_that_does_not_fit_the_trunk_is_refused() -> None:
    config = MagmaConfig.from_json(config_values(vision={"mm_hidden_size": 48}))
    with pytest.raises(CheckpointError, match=r"48 features .*32"):
        build_magma(config, torch.float32)
