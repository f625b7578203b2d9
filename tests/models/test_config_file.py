"""Numbers of configuration files have bounds: what is none is refused with its field and value."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.embedded import SIZE
from probe_kit.hooks.families.internvla.network import InternVLAConfig
from probe_kit.hooks.families.magma.network import MagmaConfig
from probe_kit.hooks.families.ovis2_5.network import VisionConfig
from probe_kit.hooks.families.pi0.network import Pi0Size
from probe_kit.hooks.families.prismatic.network import PrismaticConfig
from probe_kit.hooks.families.spatialvla.network import SpatialVLAConfig
from probe_kit.hooks.families.xiaomi.network import XiaomiConfig
from probe_kit.models.config_file import ConfigFile, Count
from probe_kit.models.decoding import Packed
from tests.hooks.families.internvla import checkpoints as internvla_checkpoints
from tests.hooks.families.magma import checkpoints as magma_checkpoints
from tests.hooks.families.prismatic import checkpoints as prismatic_checkpoints
from tests.hooks.families.spatialvla import checkpoints as spatialvla_checkpoints
from tests.hooks.families.xiaomi import checkpoints as xiaomi_checkpoints

VISION = {
    "hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 32, "patch_size": 16,
    "hidden_stride": 2, "image_size": 512, "window_size": 112, "layer_norm_eps": 1e-6, "use_rope": True,
    "preserve_original_pe": True, "temporal_patch_size": 1, "hidden_act": "gelu_pytorch_tanh", "num_channels": 3,
}  # fmt: skip


def _internvla(values: Mapping[str, Any], source: str) -> InternVLAConfig:
    return InternVLAConfig.from_values(
        internvla_checkpoints.run_values() | values, internvla_checkpoints.vlm_values(), source
    )


READERS: dict[str, tuple[Callable[[Mapping[str, Any], str], object], dict[str, Any], str]] = {
    "pi0": (Pi0Size.read, SIZE.to_json(), "vlm.depth"),
    "openvla": (PrismaticConfig.from_json, prismatic_checkpoints.config_values(), "n_action_bins"),
    "spatialvla": (SpatialVLAConfig.from_json, spatialvla_checkpoints.config_values(), "n_freqs"),
    "magma": (MagmaConfig.from_json, magma_checkpoints.config_values(), "vision_config.max_num_crops"),
    "xiaomi-r0": (XiaomiConfig.from_json, xiaomi_checkpoints.config_values(), "dit_config.hidden_size"),
    "internvla-m1": (_internvla, internvla_checkpoints.dims_values(), "dino.depth"),
    "ovis2.5": (VisionConfig.read, VISION, "window_size"),
}


@pytest.mark.parametrize("value", [-7, 0, "x", 10**30, float("nan"), 1.5, []], ids=str)
@pytest.mark.parametrize("name", READERS)
def test_a_number_that_is_none_is_refused_with_its_field_and_value(name: str, value: object) -> None:
    read, values, field = READERS[name]
    assert read(values, "a file")
    changed = json.loads(json.dumps(values))
    *parents, last = field.split(".")
    inside = changed
    for parent in parents:
        inside = inside[parent]
    inside[last] = value
    with pytest.raises(CheckpointError) as refusal:
        read(changed, "a file")
    message = str(refusal.value)
    assert "a file does not describe" in message
    assert f"{field} is {value!r}" in message


class Sizes(ConfigFile):
    network = "a network"
    model_types = ("sized",)
    width: Count
    depth: Count = 2


def test_null_is_as_if_a_field_were_missing_and_every_mistake_is_named() -> None:
    assert Sizes.read({"width": 3, "depth": None, "other": "x"}, "a file").depth == 2
    with pytest.raises(
        CheckpointError, match=r"a file does not describe a network: width is missing; depth is -1"
    ):
        Sizes.read({"width": None, "depth": -1}, "a file")


def test_a_file_of_another_model_is_refused_by_its_type(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"holds a 'llava' model; expected sized \(a network\)"):
        Sizes.from_json({"model_type": "llava", "width": 1})
    with pytest.raises(CheckpointError, match=r"config\.json is missing"):
        Sizes.from_folder(tmp_path)
    (tmp_path / "config.json").write_text('{"model_type": "sized", "width": 1}', encoding="utf-8")
    assert Sizes.from_folder(tmp_path) == Sizes(width=1)


def test_padding_stands_before_the_last_token_so_that_no_other_token_moves() -> None:
    packed = Packed.of([[1, 7, 8, 9, 10], [1, 7, 29]], padding=0)
    assert packed.ids.tolist() == [[1, 7, 8, 9, 10], [1, 7, 0, 0, 29]]
    assert packed.mask.tolist() == [[True] * 5, [True, True, False, False, True]]


def test_a_configuration_that_names_no_model_type_is_an_error_of_its_class() -> None:
    class Nameless(ConfigFile):
        width: Count

    assert Nameless.read({"width": 3}, "config.json").width == 3
    with pytest.raises(TypeError, match=r"Nameless has no model_types; name those of its config\.json"):
        Nameless.from_json({"model_type": "nameless", "width": 3})
