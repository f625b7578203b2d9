from pathlib import Path

import pytest

from probe_kit.errors import CheckpointError
from probe_kit.models.xiaomi import XiaomiConfig
from tests.support.xiaomi_checkpoints import config_values


def test_sizes_come_from_the_file() -> None:
    config = XiaomiConfig.from_json(config_values())
    assert (config.flow.layers, config.flow.width) == (2, 64)


def test_without_dit_config_the_released_size_is_meant() -> None:
    text = config_values()["vlm_config"]["text_config"] | {
        "num_hidden_layers": 16, "num_key_value_heads": 8, "head_dim": 128,
    }  # fmt: skip
    vlm = config_values()["vlm_config"] | {"text_config": text}
    flow = XiaomiConfig.from_json(config_values(vlm_config=vlm, dit_config=None)).flow
    assert (flow.layers, flow.width, flow.head_dim, flow.cached_heads) == (16, 1024, 128, 8)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"head_dim": 8}, "head_dim 8, the VLM's cache has 16"),
        ({"num_key_value_heads": 4}, "num_key_value_heads 4, the VLM's cache has 2"),
        ({"num_hidden_layers": 5}, "5 layers, the VLM has only 4"),
        ({"hidden_size": 40}, "hidden_size 40"),
    ],
)
def test_a_flow_transformer_that_cannot_read_the_cache_is_refused(change: dict[str, int], said: str) -> None:
    flow = config_values()["dit_config"] | change
    with pytest.raises(CheckpointError, match=said):
        XiaomiConfig.from_json(config_values(dit_config=flow))


def test_another_models_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="'openvla'"):
        XiaomiConfig.from_json(config_values(model_type="openvla"))
    with pytest.raises(CheckpointError, match="missing"):
        XiaomiConfig.from_folder(tmp_path)
    values = config_values()
    del values["state_dim"]
    with pytest.raises(CheckpointError, match="state_dim"):
        XiaomiConfig.from_json(values)
