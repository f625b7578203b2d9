import json
from pathlib import Path

import pytest

from probe_kit.errors import CheckpointError
from probe_kit.models.prismatic import PrismaticConfig
from tests.support.prismatic_checkpoints import config_values


def test_a_short_config_is_completed_from_the_table_and_transformers_defaults() -> None:
    """As the released files are: only the vocabulary of the language model is written down."""
    config = PrismaticConfig.from_json(
        {
            "model_type": "openvla",
            "vision_backbone_id": "dinosiglip-vit-so-384px",
            "llm_backbone_id": "llama2-7b-pure",
            "text_config": {"vocab_size": 32064},
        }
    )
    assert [(tower.timm_id, tower.image_size) for tower in config.towers] == [
        ("vit_large_patch14_reg4_dinov2.lvd142m", 384),
        ("vit_so400m_patch14_siglip_384", 384),
    ]
    assert (config.text.hidden_size, config.text.rms_norm_eps) == (4096, 1e-6)
    assert (config.action_vocabulary, config.action_bins, config.empty_token) == (32000, 256, 29871)
    assert not config.text.tie_word_embeddings


def test_clip_towers_have_quick_gelu_beside_a_tower_that_has_not() -> None:
    config = PrismaticConfig.from_json(config_values(vision="dinoclip-vit-l-336px"))
    assert [tower.act_layer for tower in config.towers] == [None, "quick_gelu"]


@pytest.mark.parametrize(
    ("language", "kind"),
    [("vicuna-v15-13b", "llama"), ("mistral-v0.1-7b-instruct", "mistral"), ("phi-2-3b", "phi")],
)
def test_the_language_id_decides_the_kind_of_language_model(language: str, kind: str) -> None:
    assert PrismaticConfig.from_json(config_values(language=language)).text.model_type == kind


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("model_type", "llava"),
        ("vision_backbone_id", "vit-unheard-of"),
        ("llm_backbone_id", "gpt-9"),
        ("image_resize_strategy", "stretch"),
        ("use_fused_vision_backbone", False),
        ("timm_model_ids", ["vit_so400m_patch14_siglip_224"]),
    ],
)
def test_what_contradicts_or_is_unknown_is_refused_by_name(field: str, value: object) -> None:
    with pytest.raises(CheckpointError, match=field if field != "model_type" else "llava"):
        PrismaticConfig.from_json({**config_values(), field: value})


def test_a_text_config_of_another_kind_than_its_id_is_refused() -> None:
    values = config_values()
    values["text_config"]["model_type"] = "phi"
    with pytest.raises(CheckpointError, match=r"llama model, but text_config describes a phi"):
        PrismaticConfig.from_json(values)


def test_a_folder_without_a_config_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"config\.json is missing"):
        PrismaticConfig.from_folder(tmp_path)


def test_what_was_trained_in_is_read_from_the_file(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps(config_values(torch_dtype="bfloat16")), encoding="utf-8")
    assert PrismaticConfig.from_folder(tmp_path).dtype == "bfloat16"
