import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from probe_kit.errors import CheckpointError
from probe_kit.models.internvla import InternVLAConfig, find_config
from tests.support.internvla_checkpoints import COT, config, dims_values, run_values, vlm_values


def named(**framework: Any) -> InternVLAConfig:
    """Without the file of other sizes: what the names of the run's file mean."""
    return InternVLAConfig.from_values(run_values(**framework), vlm_values(), "test")


def test_the_names_of_the_runs_file_mean_the_released_sizes() -> None:
    built = named()
    assert (built.dino.width, built.dino.blocks, built.dino.heads, built.dino.patch, built.dino.side) == (
        384, 12, 6, 14, 224,
    )  # fmt: skip
    assert (built.head.width, built.head.blocks, built.head.heads) == (768, 12, 12)
    assert (built.head.length, built.query.heads) == (4, 8)
    assert (built.cot, built.picture) == (COT, (224, 224))


def test_the_file_of_sizes_wins_over_the_names() -> None:
    built = config()
    assert (built.dino.width, built.dino.trained_side, built.dino.side) == (24, 70, 56)
    assert (built.head.width, built.head.heads, built.query.heads) == (32, 4, 4)


def test_the_spelling_of_the_released_file_and_the_right_one_are_read() -> None:
    right = dict(run_values()["framework"]["layer_qformer"])
    right["output_dim"] = right.pop("ouptput_dim")
    assert config(layer_qformer=right) == config()
    del right["output_dim"]
    with pytest.raises(CheckpointError, match="ouptput_dim"):
        config(layer_qformer=right)


@pytest.mark.parametrize(
    ("field", "change", "said"),
    [
        ("framework_py", "QwenGR00T", "'QwenGR00T'"),
        ("dino", {"dino_backbone": "dinov3_vits16"}, "dinov3_vits16"),
        ("action_model", {"action_model_type": "DiT-XL"}, "DiT-XL"),
        ("action_model", {"past_action_window_size": 2}, "past_action_window_size is 2"),
        ("layer_qformer", {"input_dim": 64}, "reads width 64"),
        ("layer_qformer", {"qformer_end_layer": 9}, "hidden states 3 to 9"),
        ("layer_qformer", {"ouptput_dim": 30}, "width 30 and 8 heads"),
    ],
)
def test_what_does_not_fit_is_refused(field: str, change: Any, said: str) -> None:
    before = run_values()["framework"][field]
    with pytest.raises(CheckpointError, match=said):
        named(**{field: {**before, **change} if isinstance(change, dict) else change})


def test_the_files_are_found_beside_the_weights_or_one_folder_up(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"config\.yaml or config\.json of a run is missing"):
        find_config(tmp_path / "checkpoints")
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(run_values()), encoding="utf-8")
    (tmp_path / "dims.json").write_text(json.dumps(dims_values()), encoding="utf-8")
    for folder in (tmp_path, tmp_path / "checkpoints"):
        values, place = find_config(folder)
        assert place == tmp_path
        assert values["qformer_heads"] == 4
        assert values["framework"]["layer_qformer"]["num_query_tokens"] == 6
    (tmp_path / "config.yaml").write_text("a: [", encoding="utf-8")
    with pytest.raises(CheckpointError, match="cannot be read"):
        find_config(tmp_path)
