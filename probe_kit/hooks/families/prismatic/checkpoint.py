"""The files of Prismatic checkpoints, also of TRI-ML's release and quantised ones, read without executing code.

A model of the release is a folder of the hub repository: `config.json` of its training run, and
`checkpoints/latest-checkpoint.pt` with the projector and the language model. The towers were not trained; they are
timm's published files.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from probe_kit._system.imports import require
from probe_kit.errors import CheckpointError, UsageError, WeightsError
from probe_kit.hooks.checkpoints.checkpoint import PATTERNS, RUN_WEIGHTS, WEIGHTS_FILE, chosen_dtype
from probe_kit.hooks.checkpoints.folders import AdapterFiles, adapter_in, checkpoint_folder
from probe_kit.hooks.checkpoints.weights import (
    Weights,
    check_kinds,
    read_weights,
    unpickle_weights,
    with_adapter,
)
from probe_kit.hooks.families.prismatic.network import (
    PrismaticConfig,
    PrismaticNetwork,
    TowerConfig,
    build_prismatic,
)
from probe_kit.hooks.families.shared.loading import DTYPES, Loaded, load_network
from probe_kit.models.checkpoint_files import stored_statistics


def check_quantisation(bits: int, device: str) -> None:
    """Refuse a quantisation that cannot run, before anything large is read.

    Raises:
        UsageError: For another number of bits, and for a device that is no NVIDIA GPU.
        MissingExtraError: Without bitsandbytes.
    """
    if bits not in (8, 4):
        raise UsageError(f"bits is {bits}; expected 8 or 4")
    require("bitsandbytes", "quantized")
    if not device.startswith("cuda") or not torch.cuda.is_available():
        raise UsageError(
            f"{bits}-bit weights need an NVIDIA GPU and --device cuda; device is {device!r} and CUDA is "
            f"{'available' if torch.cuda.is_available() else 'not available'}. Leave -M bits out to run exactly"
        )


def quantise(network: "PrismaticNetwork", bits: int) -> None:
    """Replace every linear layer inside the decoder's blocks; they are packed when they move to the GPU.

    Towers, projector, embeddings and the output head keep their weights.
    """
    library = require("bitsandbytes", "quantized")
    for block in network.language_model.model.layers:
        for name, linear in [(n, m) for n, m in block.named_modules() if isinstance(m, nn.Linear)]:
            parent, _, child = name.rpartition(".")
            setattr(block.get_submodule(parent), child, _pack_network(library.nn, linear, bits))


def _pack_network(layers: Any, linear: nn.Linear, bits: int) -> nn.Module:
    sizes, bias = (linear.in_features, linear.out_features), linear.bias is not None
    packed: nn.Module
    if bits == 8:
        packed = layers.Linear8bitLt(*sizes, bias=bias, has_fp16_weights=False, threshold=6.0)
        packed.weight = layers.Int8Params(linear.weight.data, requires_grad=False, has_fp16_weights=False)
    else:
        packed = layers.Linear4bit(*sizes, bias=bias, compute_dtype=linear.weight.dtype, quant_type="nf4")
        packed.weight = layers.Params4bit(linear.weight.data, requires_grad=False, quant_type="nf4")
    packed.bias = linear.bias
    return packed


# -- TRI-ML's release -----------------------------------------------------------------------------------------

_PARTS = {"projector", "llm_backbone"}
_TOWERS = "vision_backbone"
_LAYERS = {"projector.0.": "projector.fc1.", "projector.2.": "projector.fc2.", "projector.4.": "projector.fc3."}
_TAGS = {"vit_so400m_patch14_siglip_224": "webli", "vit_so400m_patch14_siglip_384": "webli"}
"""The tags of ids that name none.

The default of timm itself was SigLIP when these models were trained, and is SigLIP 2 since.
"""
_FEATURIZERS = ("featurizer", "fused_featurizer")


def read_release(file: Path, config: PrismaticConfig) -> Weights:
    """The tensors of a model of the release under the network's names.

    Towers that the file does not hold are read from timm's files on the hub. Their positions are resampled to the
    model's picture as timm does it.

    Args:
        file: `latest-checkpoint.pt`, read with `weights_only=True`.
        config: The configuration of the model, which names its towers.

    Raises:
        WeightsError: For a file of another layout.
        CheckpointError: For a tower that cannot be fetched.
    """
    content = unpickle_weights(file)
    parts = content.get("model") if isinstance(content, dict) else None
    filled = {name for name, part in parts.items() if part} if isinstance(parts, dict) else set()
    if not isinstance(parts, dict) or not filled >= _PARTS or filled - _PARTS - {_TOWERS}:
        raise WeightsError(
            f"{file} holds {', '.join(sorted(filled)) or type(content).__name__} under `model`; expected "
            f"{', '.join(sorted(_PARTS))} and perhaps {_TOWERS}. Download the checkpoint again"
        )
    tensors = dict(_rename_tensors(parts["projector"], _LAYERS, file))
    tensors |= _rename_tensors(parts["llm_backbone"], {"llm.": "language_model."}, file)
    source = str(file)
    if _TOWERS in filled:
        tensors |= _rename_tensors(parts[_TOWERS], _tower_names(parts[_TOWERS], config, file), file)
    else:
        for name, tower in zip(_FEATURIZERS, config.towers, strict=False):
            tensors |= {f"vision_backbone.{name}.{key}": value for key, value in _published_weights(tower).items()}
        source += f" and {', '.join(map(published_name, config.towers))}"
    tensors = {_scale_name(name): tensor for name, tensor in tensors.items()}
    check_kinds(tensors, file)
    return Weights(tensors, source, random=False)


def _rename_tensors(part: Any, names: Mapping[str, str], file: Path) -> Iterator[tuple[str, Tensor]]:
    """The tensors of a part with the beginnings of their names replaced.

    Raises:
        WeightsError: For a tensor with another name.
    """
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
    """Return the towers' names in the file of a fully fine-tuned model, with those here."""
    towers = dict.fromkeys(str(name).partition(".")[0] for name in part)
    if len(towers) != len(config.towers):
        raise WeightsError(
            f"{file} holds the towers {', '.join(towers)}; {config.vision_id} has {len(config.towers)} of them"
        )
    # The first of two is DINOv2's, whatever the order in the file.
    order = sorted(towers, key=lambda name: not name.startswith("dino"))
    return {f"{theirs}.": f"vision_backbone.{ours}." for theirs, ours in zip(order, _FEATURIZERS, strict=False)}


def _published_weights(tower: TowerConfig) -> dict[str, Tensor]:
    """The state dict of timm's published weights, at the side of the model's pictures."""
    timm = require("timm", "openvla")
    name = published_name(tower)
    folder = checkpoint_folder(name, (WEIGHTS_FILE, "config.json"))
    file = folder / WEIGHTS_FILE
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
    """Return the hub id of timm's published weights of a tower."""
    architecture, _, tag = tower.timm_id.partition(".")
    return f"timm/{architecture}.{tag or _TAGS[architecture]}"


def _scale_name(name: str) -> str:
    """Return the network's name of a tensor: a layer scale is `gamma` in timm and `scale_factor` in a network."""
    return name.removesuffix(".gamma") + ".scale_factor" if name.endswith(".gamma") else name


# -- loading --------------------------------------------------------------------------------------------------

FILES = (*PATTERNS, RUN_WEIGHTS)
"""The files that are needed of a hub repository, or of the folder of one model of it."""
# Files of OpenVLA-OFT: its actions come from heads that its language model's checkpoint does not name.
_OTHER_HEADS = ("action_head--*", "proprio_projector--*", "noisy_action_projector--*", "vision_backbone--*")


def checkpoint_folders(checkpoint: str, files: Sequence[str] = FILES) -> tuple[Path, ...]:
    """The folders that may hold a checkpoint's files: an adapter's own before that of its base."""
    folder = checkpoint_folder(checkpoint, files)
    adapter = adapter_in(folder)
    return (folder,) if adapter is None else tuple(dict.fromkeys((folder, adapter.base_folder(files))))


def load_checkpoint(
    checkpoint: str,
    device: str,
    dtype: str | None,
    random_weights: bool,
    bits: int | None = None,
    weights_seed: int = 0,
) -> Loaded[PrismaticNetwork]:
    """Load a folder or hub id, which may hold a LoRA adapter that names its base, or a training run's files.

    Args:
        checkpoint: Folder or hub id.
        device: Device in torch's spelling, such as `cuda:0`.
        dtype: float32 or bfloat16; None takes what the checkpoint says.
        random_weights: Whether the weights are drawn instead of read.
        bits: Quantise the language model to 8 or 4 bits after the audit; None keeps it exact.
        weights_seed: Seed of random weights.

    Raises:
        CheckpointError: For a folder that is not there, and for files that are missing or bad.
        WeightsError: For weights that are not exactly the network's.
        UsageError: For another dtype, and for a quantisation that cannot run.
        MissingExtraError: Without a package that the weights need.
    """
    if bits is not None:
        check_quantisation(bits, device)
    folder = checkpoint_folder(checkpoint, FILES)
    adapter = adapter_in(folder)
    base = folder if adapter is None else adapter.base_folder()
    _check_other_heads((folder, base))
    config = PrismaticConfig.from_folder(base)
    loaded = load_network(
        partial(build_prismatic, config),
        lambda: _read(config, base, adapter),
        checkpoint,
        base,
        device,
        chosen_dtype(dtype, config.dtype, DTYPES),
        random_weights,
        weights_seed,
        finish=lambda network: None if bits is None else quantise(network, bits),
    )
    if bits is not None:
        notes = (*loaded.notes, f"not exact: language model in {bits} bits")
        loaded = replace(loaded, dtype=f"{loaded.dtype}, {bits}-bit", exact=False, notes=notes)
    return loaded if base == folder else replace(loaded, adapter=folder)


def _check_other_heads(folders: tuple[Path, ...]) -> None:
    for folder in folders:
        for pattern in _OTHER_HEADS:
            if files := sorted(folder.glob(pattern)):
                raise CheckpointError(
                    f"{files[0]} belongs to OpenVLA-OFT, which does not decode its actions as tokens: "
                    "running it as OpenVLA would give other actions than its authors'"
                )


def _read(config: PrismaticConfig, folder: Path, adapter: AdapterFiles | None) -> Weights:
    released = folder / RUN_WEIGHTS
    weights = read_release(released, config) if released.is_file() else read_weights(folder)
    return weights if adapter is None or weights.adapter is not None else with_adapter(weights, adapter)


def prismatic_statistics(config: PrismaticConfig, folders: tuple[Path, ...]) -> tuple[Mapping[str, Any], str]:
    """The statistics beside the weights, or else those of the base's config; see `stored_statistics`."""
    return stored_statistics(folders, config.statistics, f"config.json in {folders[-1]}")
