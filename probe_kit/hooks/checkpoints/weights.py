"""Audited loading: every parameter comes from the file, and the file is identified by its hash."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from probe_kit._system.bounded_json import parse_json
from probe_kit.errors import WeightsError
from probe_kit.hooks.checkpoints.checkpoint import shard_name

SINGLE_FILE = "model.safetensors"
INDEX_FILE = "model.safetensors.index.json"
RANDOM_MARK = "probe_kit.weights"


@dataclass(frozen=True)
class Weights:
    """The tensors of a checkpoint as its files hold them; `random`: the weights are untrained."""

    tensors: Mapping[str, Tensor]
    source: str
    random: bool

    def sha256(self) -> str:
        """Hex sha256 over (name, dtype, shape, bytes) of every tensor, in name order."""
        digest = hashlib.sha256()
        for name, tensor in sorted(self.tensors.items()):
            header = [name, str(tensor.dtype).removeprefix("torch."), list(tensor.shape)]
            digest.update(json.dumps(header).encode())
            digest.update(tensor.contiguous().flatten().view(torch.uint8).numpy().tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class WeightsAudit:
    """What loading proved: `tensors` in the model equal the file, the `allowed_missing` ones do not."""

    sha256: str
    random: bool
    tensors: int
    parameters: int
    allowed_missing: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """The audit as stored with a run."""
        return asdict(self)


def read_weights(folder: Path, unlisted: Iterable[str] = ()) -> Weights:
    """Read `model.safetensors`, every shard of `model.safetensors.index.json`, or the only `.pt` file.

    A `.pt` file is read with `weights_only=True`: it cannot run code. unlisted: tensors that shards may hold
    although the index does not name them.
    Raises WeightsError if a file is missing or damaged, or if the index and the shards disagree.
    """
    index, pickles = folder / INDEX_FILE, sorted(folder.glob("*.pt"))
    if (folder / SINGLE_FILE).is_file():
        shards: dict[str, set[str] | None] = {SINGLE_FILE: None}
    elif index.is_file():
        shards = _shards(index)
    elif len(pickles) == 1:
        return read_pickle(pickles[0])
    else:
        raise WeightsError(
            f"no weights in {folder}: neither {SINGLE_FILE} nor {INDEX_FILE} nor one .pt file is there"
        )
    tensors: dict[str, Tensor] = {}
    random = False
    for name, expected in shards.items():
        content, metadata = _read_file(folder / name)
        if expected is not None and (difference := sorted((set(content) ^ expected) - (set(unlisted) - expected))):
            raise WeightsError(f"{folder / name} and {INDEX_FILE} disagree about {_names(difference)}")
        tensors |= content
        random = random or metadata.get(RANDOM_MARK, "").startswith("random")
    return Weights(tensors, str(folder), random)


def _shards(index: Path) -> dict[str, set[str] | None]:
    shards: dict[str, set[str] | None] = {}
    try:
        listed = parse_json(index.read_bytes())["weight_map"].items()
        for tensor, shard in listed:
            names = shards.setdefault(shard_name(shard), set())
            assert names is not None
            names.add(tensor)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise WeightsError(f"{index} is damaged ({error}); download the checkpoint again") from error
    return shards


def _read_file(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    if not path.is_file():
        raise WeightsError(f"{path} is missing; download the checkpoint again")
    try:
        with safe_open(path, "pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            metadata = file.metadata() or {}
    except (SafetensorError, OSError, ValueError, AttributeError) as error:
        raise WeightsError(f"{path} cannot be read ({error}); download the checkpoint again") from error
    check_kinds(tensors, path)
    return tensors, metadata


_KINDS = (
    torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.uint8, torch.bool
)  # fmt: skip
"""What weights, and buffers such as positions and masks, are made of."""


def check_kinds(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Raise WeightsError for quantised weights: they would be read as if they were the numbers they stand for."""
    strange = [f"{name} ({tensor.dtype})" for name, tensor in tensors.items() if tensor.dtype not in _KINDS]
    if strange:
        raise WeightsError(
            f"{path} holds {len(strange)} tensors of a kind that no model declares: {_names(strange)}. Take the "
            "checkpoint that is not quantised"
        )


def unpickled(path: Path) -> Any:
    """The content of a `.pt` file, read with `weights_only=True`: it cannot run code. Raises WeightsError."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except (UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError, AttributeError) as error:
        raise WeightsError(
            f"{path} cannot be read as plain tensors ({error}); it may be damaged or unsafe"
        ) from error


def read_pickle(path: Path) -> Weights:
    """Read the state dict in one `.pt` file; see `unpickled`. Raises WeightsError if it is none."""
    content = unpickled(path)
    if not isinstance(content, dict) or not all(isinstance(value, Tensor) for value in content.values()):
        raise WeightsError(
            f"{path} holds {type(content).__name__} of something else than tensors; expected a state dict"
        )
    check_kinds(content, path)
    return Weights(content, str(path), random=False)


def load_weights(
    module: nn.Module,
    weights: Weights,
    tensors: Mapping[str, Tensor],
    allowed_missing: Iterable[str] = (),
    assign: bool = False,
) -> WeightsAudit:
    """Copy `tensors` into `module` and prove that they arrived.

    weights: the files, which give the audit its hash. tensors: the same content under the module's names.
    allowed_missing: parameters that inference never reads and the file may lack.
    assign: make `tensors` themselves the parameters instead of copying them; for a module on the meta device.
    Raises WeightsError naming missing, extra, mis-shaped and non-finite tensors; the module is then not used.
    """
    state = module.state_dict()
    allowed = set(allowed_missing) & (set(state) - set(tensors))
    _refuse(weights.source, "missing", sorted(set(state) - set(tensors) - allowed))
    _refuse(weights.source, "not part of the model", sorted(set(tensors) - set(state)))
    shapes = [
        f"{name} {tuple(tensor.shape)} instead of {tuple(state[name].shape)}"
        for name, tensor in tensors.items()
        if tensor.shape != state[name].shape
    ]
    _refuse(weights.source, "of another shape", shapes)
    kinds = [
        f"{name} {tensor.dtype} instead of {state[name].dtype}"
        for name, tensor in tensors.items()
        if tensor.is_floating_point() != state[name].is_floating_point()
    ]
    _refuse(weights.source, "of another kind of number", kinds)
    damaged = [n for n, t in tensors.items() if t.is_floating_point() and not torch.isfinite(t).all()]
    _refuse(weights.source, "NaN or infinite", damaged)
    module.load_state_dict(dict(tensors), strict=not allowed, assign=assign)
    state = module.state_dict()
    changed = [n for n, t in tensors.items() if not torch.equal(state[n].cpu(), t.to(state[n].dtype))]
    _refuse(weights.source, "different after loading", changed)
    return WeightsAudit(
        weights.sha256(),
        weights.random,
        len(tensors),
        sum(parameter.numel() for parameter in module.parameters()),
        tuple(sorted(allowed)),
    )


def _refuse(source: str, what: str, names: list[str]) -> None:
    if names:
        raise WeightsError(
            f"weights in {source}: {len(names)} tensors {what}: {_names(names)}. "
            "The file does not belong to this model and configuration; nothing was run"
        )


def _names(names: list[str], shown: int = 8) -> str:
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(names[:shown]) + more
