"""The files of TRI-ML's release of Prismatic, read without executing code.

A model is a folder of the hub repository: `config.json` of its training run, and
`checkpoints/latest-checkpoint.pt` with the projector and the language model. The towers were not trained; they are
timm's published files.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from probe_kit._system.optional_dependencies import require
from probe_kit.errors import WeightsError
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import SINGLE_FILE, Weights, check_kinds, unpickled
from probe_kit.models.prismatic import PrismaticConfig, TowerConfig

_PARTS = {"projector", "llm_backbone"}
_TOWERS = "vision_backbone"
_LAYERS = {"projector.0.": "projector.fc1.", "projector.2.": "projector.fc2.", "projector.4.": "projector.fc3."}
_TAGS = {"vit_so400m_patch14_siglip_224": "webli", "vit_so400m_patch14_siglip_384": "webli"}
"""Of ids that name none: timm's own default was SigLIP when these models were trained, and is SigLIP 2 since."""
_FEATURIZERS = ("featurizer", "fused_featurizer")


def read_release(file: Path, config: PrismaticConfig) -> Weights:
    """The tensors of a model of the release under the network's names.

    file: `latest-checkpoint.pt`, read with `weights_only=True`. Towers that it does not hold are read from timm's
    files on the hub, and their positions resampled to the model's picture as timm does it.
    Raises WeightsError for a file of another layout, CheckpointError for a tower that cannot be fetched.
    """
    content = unpickled(file)
    parts = content.get("model") if isinstance(content, dict) else None
    filled = {name for name, part in parts.items() if part} if isinstance(parts, dict) else set()
    if not isinstance(parts, dict) or not filled >= _PARTS or filled - _PARTS - {_TOWERS}:
        raise WeightsError(
            f"{file} holds {', '.join(sorted(filled)) or type(content).__name__} under `model`; expected "
            f"{', '.join(sorted(_PARTS))} and perhaps {_TOWERS}. Download the checkpoint again"
        )
    tensors = dict(_renamed(parts["projector"], _LAYERS, file))
    tensors |= _renamed(parts["llm_backbone"], {"llm.": "language_model."}, file)
    source = str(file)
    if _TOWERS in filled:
        tensors |= _renamed(parts[_TOWERS], _tower_names(parts[_TOWERS], config, file), file)
    else:
        for name, tower in zip(_FEATURIZERS, config.towers, strict=False):
            tensors |= {f"vision_backbone.{name}.{key}": value for key, value in _published(tower).items()}
        source += f" and {', '.join(map(published_name, config.towers))}"
    tensors = {_scale_name(name): tensor for name, tensor in tensors.items()}
    check_kinds(tensors, file)
    return Weights(tensors, source, random=False)


def _renamed(part: Any, names: Mapping[str, str], file: Path) -> Iterator[tuple[str, Tensor]]:
    """The tensors of a part with the beginnings of their names replaced. Raises WeightsError for another name."""
    if not isinstance(part, dict):
        raise WeightsError(f"{file} holds a {type(part).__name__} in place of a state dict")
    for name, tensor in part.items():
        begin = next((begin for begin in names if str(name).startswith(begin)), None)
        if begin is None or not isinstance(tensor, Tensor):
            raise WeightsError(
                f"{file}: {name!r} is no tensor of a known part; expected names that begin with {', '.join(names)}"
            )
        yield names[begin] + name.removeprefix(begin), tensor


def _tower_names(part: Any, config: PrismaticConfig, file: Path) -> dict[str, str]:
    """The towers' names in the file of a fully fine-tuned model, and here."""
    towers = dict.fromkeys(str(name).partition(".")[0] for name in part)
    if len(towers) != len(config.towers):
        raise WeightsError(
            f"{file} holds the towers {', '.join(towers)}; {config.vision_id} has {len(config.towers)} of them"
        )
    # The first of two is DINOv2's, whatever the order in the file.
    order = sorted(towers, key=lambda name: not name.startswith("dino"))
    return {f"{theirs}.": f"vision_backbone.{ours}." for theirs, ours in zip(order, _FEATURIZERS, strict=False)}


def _published(tower: TowerConfig) -> dict[str, Tensor]:
    """The state dict of timm's published weights, at the side of the model's pictures."""
    timm = require("timm", "openvla")
    name = published_name(tower)
    folder = checkpoint_folder(name, (SINGLE_FILE, "config.json"))
    file = folder / SINGLE_FILE
    if not file.is_file():
        raise WeightsError(f"{file} is missing; download {name} again")
    network = timm.create_model(
        tower.timm_id,
        pretrained=True,
        pretrained_cfg_overlay={"file": str(file)},
        num_classes=0,
        img_size=tower.image_size,
        act_layer=tower.act_layer,
        **tower.overrides,
    )
    with torch.no_grad():
        return {name: tensor.clone() for name, tensor in network.state_dict().items()}


def published_name(tower: TowerConfig) -> str:
    """Hub id of timm's published weights of a tower."""
    architecture, _, tag = tower.timm_id.partition(".")
    return f"timm/{architecture}.{tag or _TAGS[architecture]}"


def _scale_name(name: str) -> str:
    """timm calls a layer scale `gamma`, the network `scale_factor`."""
    return name.removesuffix(".gamma") + ".scale_factor" if name.endswith(".gamma") else name
