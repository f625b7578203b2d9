"""Audited loading: every parameter comes from the file, which its hash identifies; LoRA adapters are merged."""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from itertools import accumulate, takewhile
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import torch
from safetensors import safe_open
from torch import Tensor, nn

from probe_kit._system.bounded_files import load_json
from probe_kit._system.foreign_files import while_reading
from probe_kit._system.imports import require
from probe_kit.errors import WeightsError
from probe_kit.hooks.checkpoints.checkpoint import INDEX_FILE, WEIGHTS_FILE, check_unambiguous, shard_name
from probe_kit.hooks.checkpoints.folders import SCALING, AdapterFiles, adapter_in
from probe_kit.models.building import builds_sizes_only

_PREFIX, _COPY, _BASE = "base_model.model.", "modules_to_save.", ".base_layer."
_EMBEDDINGS = ("embed_tokens", "lm_head")
"""The modules that peft knows as embedding layers, its `EMBEDDING_LAYER_NAMES`."""
_FACTORS = (
    ".lora_A.", ".lora_B.", ".lora_embedding_A", ".lora_embedding_B", ".lora_magnitude_vector",
)  # fmt: skip


_PATTERNS = ("rank_pattern", "alpha_pattern")
"""The settings that give single modules other values, by regular expressions of their paths."""


@dataclass(frozen=True)
class Adapter:
    """A LoRA adapter with its tensors, by the names that peft gave them."""

    files: AdapterFiles
    tensors: Mapping[str, Tensor]

    @property
    def folder(self) -> Path:
        """The folder of the adapter."""
        return self.files.folder

    @property
    def scaling(self) -> dict[str, Any]:
        """The settings that decide how much it adds."""
        return {name: self.files.settings[name] for name in SCALING if self.files.settings.get(name)}

    def merged(
        self, module: nn.Module, tensors: Mapping[str, Tensor], name_in_module: Callable[[str], str] = str
    ) -> "MergedTensors":
        """Return `tensors` with the adapter in them: W + s B A in float32, rounded once to the weight's own dtype.

        The adapter of a layer changes that layer alone, as in training: of weights that are tied to each other,
        the other one keeps its numbers. A base's own tensor that peft stored beside the factors replaces the
        base's, as peft itself loads it, and with it what is tied to it.

        Args:
            module: The network that they belong to, on any device; it stays as it is.
            tensors: The base's, under the module's names.
            name_in_module: The module's name of a tensor in a file.

        Raises:
            WeightsError: Unless every tensor of the adapter has its place in the network and every place its
                factors.
            MissingExtraError: Without peft.
        """
        parts = self._sort_tensors()
        merged, notes = dict(tensors), []
        tied = {double: original for double, original in doubles(module).items() if original in merged}
        for double, original in tied.items():
            merged.setdefault(double, merged[original])
        for name, tensor in parts.bases.items():
            target, stored = self._rename_whole(name, tensor, merged, name_in_module)
            if not torch.equal(stored, merged[target]):
                largest = float((stored.float() - merged[target].float()).abs().max())
                notes.append(f"its own {name} replaces the base's, from which it differs by up to {largest:.3g}")
            for partner in _tied_to(target, tied):
                merged[partner] = stored
        for name, tensor in parts.copies.items():
            target, stored = self._rename_whole(name, tensor, merged, name_in_module)
            merged[target] = stored
        for path, layer_factors in parts.factors.items():
            weight = self._target(f"{path}.weight", merged, name_in_module)
            layer = module.get_submodule(weight.removesuffix(".weight"))
            bias = f"{weight.removesuffix('.weight')}.bias"
            before = {"weight": merged[weight], **({"bias": merged[bias]} if bias in merged else {})}
            for name, tensor in self._merged_layer(path, layer, before, layer_factors).items():
                target = weight if name == "weight" else bias
                merged[target] = tensor.to(merged[target].dtype)
        for double, original in tied.items():
            if torch.equal(merged[double], merged[original]) and double not in tensors:
                del merged[double]
            elif not torch.equal(merged[double], merged[original]):
                notes.append(f"{double} is no longer tied to {original}")
        return MergedTensors(merged, tuple(notes))

    def _rename_whole(
        self, name: str, tensor: Tensor, tensors: Mapping[str, Tensor], name_in_module: Callable[[str], str]
    ) -> tuple[str, Tensor]:
        """The network's name of a whole tensor, and the tensor in the dtype that the weight has there."""
        target = self._target(name, tensors, name_in_module)
        if tensors[target].shape != tensor.shape:
            raise WeightsError(
                f"the LoRA adapter in {self.folder} replaces {name} of shape {tuple(tensors[target].shape)} by "
                f"{tuple(tensor.shape)}; it belongs to another model"
            )
        return target, tensor.to(tensors[target].dtype)

    def _sort_tensors(self) -> "_AdapterParts":
        """Return low-rank factors, copies of the base's own tensors, and whole tensors that replace the base's.

        Raises:
            WeightsError: For tensors that are none of these, NaN or infinite ones, and ones that are missing.
        """
        if damaged := [name for name, tensor in self.tensors.items() if not torch.isfinite(tensor).all()]:
            raise WeightsError(
                f"{self.folder}: NaN or infinite tensors in the adapter: {_few(damaged)}. Its training diverged, "
                "or the file is damaged: take an earlier checkpoint, or download it again"
            )
        factors: dict[str, dict[str, Tensor]] = {}
        copies: dict[str, Tensor] = {}
        bases: dict[str, Tensor] = {}
        replaced = tuple(self.files.settings.get("modules_to_save") or ())
        for name, tensor in self.tensors.items():
            bare = name.removeprefix(_PREFIX)
            if (part := next((part for part in _FACTORS if part in bare), None)) is not None:
                factors.setdefault(bare.partition(part)[0], {})[name] = tensor
            elif _BASE in bare or (_is_embedding(bare) and not _inside(bare, replaced)):
                bases[bare.replace(_BASE, ".")] = tensor
            else:
                copies[bare.replace(_COPY, "").replace(".default.", ".")] = tensor
        biases = self.files.settings.get("bias", "none") != "none"
        strange = [name for name in copies if not (_inside(name, replaced) or (biases and name.endswith(".bias")))]
        strange += [name for name in bases if not (name.rpartition(".")[0] in factors or _is_embedding(name))]
        if strange or not self.tensors:
            raise WeightsError(
                f"{self.folder} holds something else than low-rank factors: {_few(strange) or 'no tensors'}. "
                "Merge it with the tool that made it, and pass the merged folder"
            )
        if lost := [module for module in replaced if not any(_inside(name, (module,)) for name in copies)]:
            raise WeightsError(
                f"{self.folder} has no tensors of {_few(lost)}, which its modules_to_save name. Download the "
                "adapter again"
            )
        return _AdapterParts(factors, bases, copies)

    def _target(self, name: str, tensors: Mapping[str, Tensor], name_in_module: Callable[[str], str]) -> str:
        """The network's name of a weight that the adapter changes."""
        for candidate in (name, name_in_module(name)):
            if candidate in tensors:
                return candidate
        raise WeightsError(
            f"the LoRA adapter in {self.folder} changes {name}, which the model does not have; it belongs to "
            "another model"
        )

    def _merged_layer(
        self, path: str, layer: nn.Module, parts: Mapping[str, Tensor], factors: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Weight and bias of one layer after peft merged its factors, float32."""
        peft: Any = require("peft", "lora")
        twin = deepcopy(layer).to_empty(device="cpu").float()
        twin.load_state_dict({name: tensor.float() for name, tensor in parts.items()})
        tree, (*parents, last) = nn.Module(), path.split(".")
        inner = tree
        for parent in parents:
            inner.add_module(parent, nn.Module())
            inner = inner.get_submodule(parent)
        inner.add_module(last, twin)
        # The tensors say which modules change; "all-linear" and patterns would be resolved by peft's own rules.
        scaling = {
            name: _pattern_entry(value, path) if name in _PATTERNS else value
            for name, value in self.scaling.items()
        }
        config = peft.LoraConfig(target_modules=[path], bias="none", inference_mode=True, **scaling)
        try:
            wrapped = peft.get_peft_model(tree, config)
        except (ValueError, TypeError) as error:
            raise WeightsError(f"the LoRA adapter in {self.folder} cannot be merged at {path}: {error}") from error
        placed = peft.get_peft_model_state_dict(wrapped, save_embedding_layers=False)
        expected = {name: tensor.shape for name, tensor in placed.items()}
        shapes = {name: tensor.shape for name, tensor in factors.items()}
        if wrong := sorted(
            name for name in expected.keys() | shapes.keys() if expected.get(name) != shapes.get(name)
        ):
            raise WeightsError(
                f"the LoRA adapter in {self.folder} does not fit the model: tensors missing, extra or of another "
                f"shape: {_few(wrong)}"
            )
        peft.set_peft_model_state_dict(wrapped, {name: tensor.float() for name, tensor in factors.items()})
        try:
            unloaded = wrapped.merge_and_unload()
        except RuntimeError as error:  # a bias of factors beside a layer that has none
            raise WeightsError(f"the LoRA adapter in {self.folder} cannot be merged at {path}: {error}") from error
        return dict(unloaded.get_submodule(path).state_dict())


@dataclass(frozen=True)
class MergedTensors:
    """The tensors of a base with an adapter in them.

    Attributes:
        tensors: Under the network's names. Of weights that the network ties, both are there where they differ.
        notes: What else the adapter changed, in words.
    """

    tensors: dict[str, Tensor]
    notes: tuple[str, ...]


class _AdapterParts(NamedTuple):
    """The tensors of an adapter.

    Attributes:
        factors: Low-rank factors by module, under the names that peft gave them.
        bases: The base's own tensors, which peft stores where an embedding is among the targets or was resized.
        copies: Tensors of modules that were trained whole, and biases.
    """

    factors: dict[str, dict[str, Tensor]]
    bases: dict[str, Tensor]
    copies: dict[str, Tensor]


def _pattern_entry(pattern: Mapping[str, Any], path: str) -> dict[str, Any]:
    """The one entry of a pattern that is for a module, if any; peft warns about entries that match none."""
    from peft.utils.other import get_pattern_key

    key = get_pattern_key(tuple(pattern), path)
    return {key: pattern[key]} if key in pattern else {}


def _is_embedding(name: str) -> bool:
    """Whether a tensor is of a module that peft saves as an embedding layer."""
    return any(f".{name}".endswith(f".{module}.weight") for module in _EMBEDDINGS)


def _tied_to(name: str, tied: Mapping[str, str]) -> set[str]:
    """The names of one parameter, among the doubles of a network and their originals."""
    original = tied.get(name, name)
    return {original, *(double for double, other in tied.items() if other == original)}


def doubles(network: nn.Module) -> dict[str, str]:
    """Return the parameters that are another one's double, with the name of that one."""
    names = {id(parameter): name for name, parameter in network.named_parameters()}
    every = network.named_parameters(remove_duplicate=False)
    return {name: names[id(parameter)] for name, parameter in every if names[id(parameter)] != name}


def _inside(name: str, modules: Iterable[str]) -> bool:
    """Whether a tensor belongs to one of these modules, which may be named by the end of their path."""
    return any(f".{module}." in f".{name}" for module in modules)


def _few(names: list[str], most: int = 8) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


# -- reading and loading --------------------------------------------------------------------------------------

RANDOM_MARK = "probe_kit.weights"
_WRAPPERS = (
    "_orig_mod", "_fsdp_wrapped_module", "_checkpoint_wrapped_module", "_forward_module", "_ddp_module", "module",
)  # fmt: skip
"""The names that torch.compile, FSDP, activation checkpoints, DeepSpeed, lightning and DDP give to a module."""
_FEWEST = 2
"""The smallest number of names that can have something in common."""


@dataclass(frozen=True)
class Weights:
    """The tensors of a checkpoint as its files hold them.

    Attributes:
        random: Whether the weights are untrained.
        adapter: The adapter that `load_weights` merges into them; None for none.
    """

    tensors: Mapping[str, Tensor]
    source: str
    random: bool
    adapter: Adapter | None = None

    def sha256(self) -> str:
        """Return the hex sha256 over (name, dtype, shape, bytes) of every tensor, in name order.

        Where there is an adapter, it is over the tensors of base and adapter, and over the settings that scale
        what the adapter adds. Their merge is rounded, and its last bits may differ between machines.
        """
        digest = hashlib.sha256()
        tensors = dict(self.tensors)
        if self.adapter is not None:
            digest.update(json.dumps(["adapter", self.adapter.scaling], sort_keys=True).encode())
            tensors |= self.adapter.tensors
        for name, tensor in sorted(tensors.items()):
            header = [name, str(tensor.dtype).removeprefix("torch."), list(tensor.shape)]
            digest.update(json.dumps(header).encode())
            digest.update(tensor.contiguous().flatten().view(torch.uint8).numpy().tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class WeightsAudit:
    """The result of loading: `tensors` in the model equal the file, the `allowed_missing` ones do not.

    Attributes:
        adapter: The adapter that was merged into the file's tensors, in words; empty for none.
    """

    sha256: str
    random: bool
    tensors: int
    parameters: int
    allowed_missing: tuple[str, ...]
    adapter: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the audit as stored with a run."""
        return asdict(self)


def read_weights(folder: Path, unlisted: Iterable[str] = ()) -> Weights:
    """Read `model.safetensors`, every shard of `model.safetensors.index.json`, or the only `.pt` file.

    Of a LoRA adapter its tensors and those of its base are read, which `load_weights` merges. A `.pt` file is read
    with `weights_only=True`: it cannot run code.

    Args:
        folder: The folder of the checkpoint or of the adapter.
        unlisted: Tensors that shards may hold although the index does not name them.

    Raises:
        WeightsError: If a file is missing or damaged, if the index and the shards disagree, or if there are two
            sets of weights.
        CheckpointError: For an adapter that cannot be merged exactly.
    """
    files = adapter_in(folder)
    return _read_folder(folder, unlisted) if files is None else with_adapter(
        _read_folder(files.base_folder(), unlisted), files
    )  # fmt: skip


def with_adapter(base: Weights, files: AdapterFiles) -> Weights:
    """Return the base's weights with an adapter to be merged.

    Raises:
        WeightsError: If the adapter's file cannot be read.
    """
    path = files.weights
    if path.suffix == ".bin":
        tensors = dict(read_pickle(path).tensors)
    else:
        tensors, _ = _read_file(path)
    return replace(base, source=f"{base.source} and {files.folder}", adapter=Adapter(files, tensors))


def _read_folder(folder: Path, unlisted: Iterable[str]) -> Weights:
    check_unambiguous(folder)
    index, pickles = folder / INDEX_FILE, sorted(folder.glob("*.pt"))
    if (folder / WEIGHTS_FILE).is_file():
        shards: dict[str, set[str] | None] = {WEIGHTS_FILE: None}
    elif index.is_file():
        shards = _shards(index)
    elif len(pickles) == 1:
        return read_pickle(pickles[0])
    else:
        raise WeightsError(
            f"no weights in {folder}: neither {WEIGHTS_FILE} nor {INDEX_FILE} nor one .pt file is there"
        )
    tensors: dict[str, Tensor] = {}
    random = False
    for name, expected in shards.items():
        content, metadata = _read_file(folder / name)
        if expected is not None and (difference := sorted((set(content) ^ expected) - (set(unlisted) - expected))):
            raise WeightsError(
                f"{folder / name} and {INDEX_FILE} disagree about {_few(difference)}: one of them belongs to "
                "another checkpoint. Download the checkpoint again"
            )
        tensors |= content
        random = random or metadata.get(RANDOM_MARK, "").startswith("random")
    return Weights(tensors, str(folder), random)


def _shards(index: Path) -> dict[str, set[str] | None]:
    shards: dict[str, set[str] | None] = {}
    try:
        listed = load_json(index)["weight_map"].items()
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
    with while_reading(path, WeightsError, "Download the checkpoint again"), safe_open(path, "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        metadata = file.metadata() or {}
    check_kinds(tensors, path)
    return tensors, metadata


_KINDS = (
    torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.uint8, torch.bool
)  # fmt: skip
"""The dtypes of weights, and of buffers such as positions and masks."""


def check_kinds(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Raise WeightsError for quantised weights: they would be read as if they were the numbers they stand for."""
    strange = [f"{name} ({tensor.dtype})" for name, tensor in tensors.items() if tensor.dtype not in _KINDS]
    if strange:
        raise WeightsError(
            f"{path} holds {len(strange)} tensors of a kind that no model declares: {_few(strange)}. Take the "
            "checkpoint that is not quantised"
        )


def unpickle_weights(path: Path) -> Any:
    """The content of a `.pt` file, read with `weights_only=True`: it cannot run code.

    Raises:
        WeightsError: For a file that cannot be read as plain tensors, or holds them compressed.
    """
    _check_not_compressed(path)
    advice = "Expected plain tensors: it may be damaged or unsafe"
    with while_reading(path, WeightsError, advice):
        return torch.load(path, map_location="cpu", weights_only=True)


def _check_not_compressed(path: Path) -> None:
    """Raise WeightsError for a zip file with compressed members: a small one can stand for all memory."""
    try:
        with ZipFile(path) as packed:
            compressed = [entry.filename for entry in packed.infolist() if entry.compress_type != ZIP_STORED]
    except (BadZipFile, OSError, ValueError, NotImplementedError):
        return  # the older format of torch, or damage, which torch names
    if compressed:
        raise WeightsError(
            f"{path} holds {compressed[0]!r} compressed; torch.save compresses nothing. Save the tensors again"
        )


def read_pickle(path: Path) -> Weights:
    """Read the state dict in one `.pt` file; see `unpickle_weights`.

    Raises:
        WeightsError: If the file holds no state dict.
    """
    content = unpickle_weights(path)
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
    name_in_module: Callable[[str], str] = str,
) -> WeightsAudit:
    """Copy `tensors` into `module` and prove that they arrived.

    Args:
        module: The network, on any device.
        weights: The files, which give the audit its hash.
        tensors: The same content under the module's names.
        allowed_missing: Parameters that inference never reads and the file may lack.
        assign: Make `tensors` themselves the parameters instead of copying them; for a module on the meta device.
        name_in_module: The module's name of a tensor in a file, for the adapter that is merged.

    Raises:
        WeightsError: Naming missing, extra, mis-shaped and non-finite tensors; the module is then not used.
    """
    if builds_sizes_only():
        return WeightsAudit("", True, 0, sum(weight.numel() for weight in module.parameters()), ())
    state = module.state_dict()
    _refuse_wrapped(weights, tensors, state)
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
    adapter = ""
    if weights.adapter is not None:
        merged = weights.adapter.merged(module, tensors, name_in_module)
        tensors = merged.tensors
        adapter = "; ".join([f"LoRA adapter merged into {weights.adapter.files.base}", *merged.notes])
        if not assign:
            _untie(module, tensors)
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
        adapter,
    )


def _untie(module: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Give tied parameters memory of their own where they get different numbers."""
    for double, original in doubles(module).items():
        if double in tensors and original in tensors and not torch.equal(tensors[double], tensors[original]):
            parent, _, name = double.rpartition(".")
            weight = module.get_parameter(double)
            setattr(module.get_submodule(parent), name, nn.Parameter(torch.empty_like(weight)))


def _refuse_wrapped(weights: Weights, tensors: Mapping[str, Tensor], state: Mapping[str, Tensor]) -> None:
    """Raise WeightsError where tensors are missing because all names are another's: a wrapper's, or factors'."""
    missing = set(state) - set(tensors)
    strange = sorted(set(tensors) - set(state))
    if factors := [name for name in strange if ".lora_A." in name or ".lora_B." in name]:
        raise WeightsError(
            f"weights in {weights.source} hold {len(factors)} low-rank factors that were not merged: "
            f"{_few(factors, 2)}. Merge them with the tool that trained the model, and save it again"
        )
    wrapper = _wrapper(list(weights.tensors), list(state)) if missing and strange else ""
    if wrapper:
        wrapped = [name for name in weights.tensors if wrapper in name]
        raise WeightsError(
            f"weights in {weights.source}: {len(wrapped)} of {len(weights.tensors)} names hold {wrapper!r}, "
            f"such as {min(wrapped)}, and the model does not. A module that was compiled, distributed or part "
            f"of a larger one was saved: save its tensors again without {wrapper!r}. Nothing was run"
        )


def _wrapper(stored: Sequence[str], model: Sequence[str]) -> str:
    """The prefix that stands in the names of a file and in none of the model's; empty where there is none.

    Wrappers of torch and of training libraries put their name before all names or between their parts. A module of
    a larger one has the name that it has there in front.
    """
    common = _common_path(stored) if len(stored) >= _FEWEST else ""
    if common and not any(name.startswith(f"{common.partition('.')[0]}.") for name in model):
        for end in accumulate(common.split("."), "{}.{}".format):
            if {name.removeprefix(f"{end}.") for name in stored} & set(model):
                return f"{end}."
    parts, model_parts = ({part for name in names for part in name.split(".")[:-1]} for names in (stored, model))
    inside = [part for part in _WRAPPERS if part in parts - model_parts]
    first = common.partition(".")[0]
    return f"{inside[0]}." if inside else f"{first}." if first and first not in model_parts else ""


def _common_path(names: Sequence[str]) -> str:
    """The modules that all tensors lie in, dotted; empty where there is none."""
    first, last = min(names).split(".")[:-1], max(names).split(".")[:-1]
    shared = takewhile(lambda pair: pair[0] == pair[1], zip(first, last, strict=False))
    return ".".join(part for part, _ in shared)


def _refuse(source: str, what: str, names: list[str]) -> None:
    if names:
        raise WeightsError(
            f"weights in {source}: {len(names)} tensors {what}: {_few(names)}. "
            "The file does not belong to this model and configuration; nothing was run"
        )
