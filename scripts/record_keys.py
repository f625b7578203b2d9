"""Record the tensors of a released size: names, shapes and dtypes of lerobot's own policy, on the meta device.

    uv run python scripts/record_keys.py FAMILY FILE

FAMILY: pi05, pi0-fast, molmoact2, groot, xvla or eo1. FILE: `real_keys.json.gz`. Sizes are those of the published
configurations; of probe_kit only these are used, none of its builders. `probe-kit verify FAMILY --keys FILE`
compares the adapter's network with the list.
"""

import argparse
import gzip
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lerobot
import torch
from lerobot.configs.types import FeatureType, PolicyFeature

from probe_kit.models.building import replace_attributes

PICTURE = {"observation.images.image": PolicyFeature(FeatureType.VISUAL, (3, 224, 224))}


def pi05() -> dict[str, torch.Tensor]:
    """Gemma 2B and 300M, as lerobot/pi05_base has them."""
    from lerobot.policies.pi05.configuration_pi05 import PI05Config
    from lerobot.policies.pi05.modeling_pi05 import PI05Policy

    return PI05Policy(_on_meta(PI05Config(device="cpu"))).state_dict()


def pi0_fast() -> dict[str, torch.Tensor]:
    """Gemma 2B, as lerobot/pi0fast-base has it; its tokenizers have no tensor."""
    from lerobot.policies.pi0_fast import modeling_pi0_fast
    from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig

    nothing = SimpleNamespace(from_pretrained=lambda *_, **__: None)
    with replace_attributes(modeling_pi0_fast, {"AutoProcessor": nothing, "AutoTokenizer": nothing}):
        return modeling_pi0_fast.PI0FastPolicy(_on_meta(PI0FastConfig(device="cpu"))).state_dict()


def molmoact2() -> dict[str, torch.Tensor]:
    """As allenai/MolmoAct2 and its fine-tunes have it, stored in bfloat16 by lerobot's default."""
    from lerobot.policies.molmoact2.molmoact2_hf_model.configuration_molmoact2 import MolmoAct2Config
    from lerobot.policies.molmoact2.molmoact2_hf_model.modeling_molmoact2 import MolmoAct2ForConditionalGeneration

    from probe_kit.hooks.families.molmoact2.adapter import RELEASED

    torch.set_default_dtype(torch.bfloat16)  # buffers that are computed in float32 stay so
    network = MolmoAct2ForConditionalGeneration(MolmoAct2Config(**RELEASED))
    return {f"model.{name}": tensor for name, tensor in network.state_dict().items()}


def groot() -> dict[str, torch.Tensor]:
    """As nvidia/GR00T-N1.7-3B has it: lerobot holds that configuration, and Cosmos-Reason2's, itself."""
    from lerobot.policies.groot.groot_n1_7 import GR00TN17, GR00TN17Config

    config = GR00TN17Config(use_flash_attention=False, load_bf16=False)
    network = GR00TN17(config, {"trust_remote_code": False}, load_backbone_weights=False).float()
    return {f"_groot_model.{name}": tensor for name, tensor in network.state_dict().items()}


def xvla() -> dict[str, torch.Tensor]:
    """As lerobot/xvla-base and 2toINF's own releases have it: Florence-2 large."""
    from lerobot.policies.xvla.configuration_xvla import XVLAConfig
    from lerobot.policies.xvla.modeling_xvla import XVLAPolicy

    from probe_kit.hooks.families.xvla.adapter import FLORENCE_LARGE

    config = XVLAConfig(
        device="cpu",
        florence_config=FLORENCE_LARGE,
        input_features={**PICTURE, "observation.state": PolicyFeature(FeatureType.STATE, (20,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (20,))},
    )
    return XVLAPolicy(_on_meta(config)).state_dict()


def eo1() -> dict[str, torch.Tensor]:
    """As EO-1's authors have it: Qwen2.5-VL-3B."""
    from lerobot.policies.eo1.configuration_eo1 import EO1Config
    from lerobot.policies.eo1.modeling_eo1 import EO1Policy

    from probe_kit.hooks.families.shared.qwen.network import qwen2_5_vl_config

    sizes = qwen2_5_vl_config("3B").to_dict()
    config = EO1Config(device="cpu", dtype="float32", vlm_config=sizes, input_features=PICTURE)
    config.pretrained_path = Path()
    return EO1Policy(_on_meta(config)).state_dict()


FAMILIES: dict[str, Callable[[], dict[str, torch.Tensor]]] = {
    "pi05": pi05, "pi0-fast": pi0_fast, "molmoact2": molmoact2, "groot": groot, "xvla": xvla,
    "eo1": eo1,
}  # fmt: skip


def _on_meta(config: Any) -> Any:
    """Set the meta device, to which lerobot moves its policies."""
    config.device = "meta"
    return config


def main() -> None:
    """Write the list and print what it holds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("family", choices=list(FAMILIES))
    parser.add_argument("file", type=Path)
    arguments = parser.parse_args()
    with torch.device("meta"):
        tensors = FAMILIES[arguments.family]()
    keys = {
        name: {"shape": list(tensor.shape), "dtype": str(tensor.dtype).removeprefix("torch.")}
        for name, tensor in sorted(tensors.items())
    }
    source = (
        f"lerobot {lerobot.__version__}, {(FAMILIES[arguments.family].__doc__ or '').rstrip('.')}; meta device"
    )
    content = json.dumps({"source": source, "keys": keys}).encode()
    arguments.file.write_bytes(gzip.compress(content, mtime=0))
    print(
        f"{len(keys)} tensors, {sum(data.numel() * data.element_size() for data in tensors.values()) / 1e9:.2f} GB"
    )


if __name__ == "__main__":
    main()
