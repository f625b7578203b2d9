"""Compare an adapter with outputs recorded from the original implementation, as `probe-kit verify` does."""

import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import UNREADABLE, load_gzipped_json, load_json, open_arrays
from probe_kit.errors import UsageError
from probe_kit.hooks.checkpoints.third_party import import_object, in_words, while_loading
from probe_kit.hooks.registry import find_family
from probe_kit.models.checkpoint_files import rename_tensor

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks.outputs import Arrays, Outputs


Status = Literal["ok", "over", "not compared"]
REFERENCE_FILE, CHECKPOINT_FOLDER = "reference.npz", "checkpoint"


@dataclass(frozen=True)
class Comparison:
    """A recorded output and ours; `error` is the largest absolute difference, None if not compared."""

    output: str
    status: Status
    error: float | None
    tolerance: float
    note: str = ""


@dataclass(frozen=True)
class Verification:
    """All comparisons of one golden reference."""

    family: str
    source: str
    comparisons: tuple[Comparison, ...]

    @property
    def passed(self) -> bool:
        """Whether something was compared and nothing is over its tolerance."""
        statuses = {comparison.status for comparison in self.comparisons}
        return "ok" in statuses and "over" not in statuses

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        return {**asdict(self), "passed": self.passed}


def compare(recorded: "Arrays", outputs: "Outputs") -> tuple[Comparison, ...]:
    """Compare every recorded quantity but the inputs."""
    remade = {name: recorded[entered] for name, entered in outputs.remade.items() if entered in recorded}
    names = {name for name in recorded if not name.startswith("in_")} - set(outputs.inputs)
    theirs = {name: recorded[name] for name in names} | remade
    return tuple(_compare_output(name, theirs[name], outputs) for name in sorted(theirs))


def _compare_output(name: str, theirs: NDArray[Any], outputs: "Outputs") -> Comparison:
    tolerance = outputs.tolerances.get(name, outputs.tolerance)
    if name not in outputs.produced:
        return Comparison(name, "not compared", None, tolerance, "the adapter does not produce it")
    ours = np.asarray(outputs.produced[name]())
    if ours.shape != theirs.shape:
        return Comparison(name, "over", None, tolerance, f"shape {ours.shape}, recorded {theirs.shape}")
    error = _largest_error(ours, theirs, outputs.valid.get(name))
    exact = not np.issubdtype(theirs.dtype, np.floating)
    allowed = tolerance if name in outputs.absolute and not exact else _tolerance(theirs, tolerance)
    return Comparison(name, "ok" if error <= allowed else "over", error, allowed)


def _tolerance(theirs: NDArray[Any], tolerance: float) -> float:
    """Return the tolerance, absolute plus relative to the largest recorded value.

    Ids, masks and counts must be equal.
    """
    if not np.issubdtype(theirs.dtype, np.floating):
        return 0.0
    size = np.abs(theirs.astype(np.float64))
    return tolerance * (1 + float(size[np.isfinite(size)].max(initial=0.0)))


def _largest_error(ours: NDArray[Any], theirs: NDArray[Any], valid: NDArray[np.bool_] | None) -> float:
    """Return the largest absolute difference; NaN on either side counts as infinitely wrong."""
    difference = np.abs(ours.astype(np.float64) - theirs.astype(np.float64))
    if valid is not None:
        difference = difference[..., valid, :]
    worst = float(difference.max(initial=0.0))
    return worst if np.isfinite(worst) else float("inf")


def verify_reference(family: str, folder: Path) -> Verification:
    """Compare an adapter with `folder/reference.npz`, on the model in `folder/checkpoint`.

    Raises what checking and loading raise, too.

    Args:
        family: Name of the family.
        folder: The golden reference.

    Raises:
        UnknownModelError: For a family that does not exist.
        UsageError: For a folder without a reference or a family that compares nothing.
    """
    declared, file = find_family(family), folder / REFERENCE_FILE
    if not file.is_file():
        raise UsageError(
            f"{folder} is not a golden reference: it has no {REFERENCE_FILE}. Give a folder that has one, and the "
            f"recorded model in {CHECKPOINT_FOLDER}/"
        )
    declared.check_purpose("outputs")
    recorded = _read_arrays(file)
    declared.check(str(folder / CHECKPOINT_FOLDER))
    outputs = declared.function("outputs")
    with while_loading(family, str(folder)):
        produced = outputs(import_object(declared.loader), folder, recorded)
        return Verification(family, str(folder), compare(recorded, produced))


def _read_arrays(file: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an .npz file.

    Raises:
        UsageError: If it is damaged or holds something else than numbers.
    """
    try:
        with open_arrays(file) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except UNREADABLE as why:
        raise UsageError(
            f"{file} cannot be read as arrays ({in_words(why)}). Record it again, or copy it again from its source"
        ) from why


def verify_keys(family: str, file: Path) -> Verification:
    """Build the full-size model on the meta device and compare names, shapes and dtypes with a recorded list.

    Keys that the family declares as `unstored` may be recorded; they are listed as not compared. A name that
    stands for another one's tensor, such as tied output weights, may be absent. Of several released sizes the one
    that the list differs least from is meant.

    Args:
        family: Name of the family.
        file: JSON, or gzipped JSON, with `keys`: {name: {"shape": [...], "dtype": "float32"}}, under the network's
            names or those of released files.
    """
    declared = find_family(family)
    declared.check_purpose("full_size")
    recorded = _read_key_list(file)
    build, renames = declared.function("full_size"), declared.renames()
    theirs = {
        rename_tensor(name, renames): (tuple(entry["shape"]), entry["dtype"]) for name, entry in recorded.items()
    }
    sizes: list[str | None] = [name for name, _ in declared.checkpoints.sizes] or [None]
    differences = {
        size: _differences(build(size) if size else build(), theirs, declared.checkpoints.unstored)
        for size in sizes
    }
    size = min(differences, key=lambda name: len(differences[name]))
    wrong, unstored = (
        differences[size],
        sorted(name for name in theirs if _is_declared(name, declared.checkpoints.unstored)),
    )
    comparison = Comparison(
        f"{len(theirs) - len(unstored)} keys{f' of {size}' if size else ''}",
        "over" if wrong else "ok", float(len(wrong)), 0.0, "; ".join(wrong[:8]),
    )  # fmt: skip
    left_out = Comparison(
        f"{len(unstored)} keys the network does not have", "not compared", None, 0.0,
        f"declared by the family as never read: {', '.join(unstored)}",
    )  # fmt: skip
    return Verification(family, str(file), (comparison, left_out) if unstored else (comparison,))


Described = tuple[tuple[int, ...], str]


def _differences(network: Any, theirs: Mapping[str, Described], unstored: tuple[str, ...]) -> list[str]:
    """The differences between a list of keys and this network's; empty if there are none."""
    state = network.state_dict(keep_vars=True)
    ours = {name: _describe(tensor) for name, tensor in state.items()}
    present = {id(state[name]) for name in ours.keys() & theirs.keys()}
    wrong = [
        f"{name}: missing here" for name in sorted(theirs.keys() - ours.keys()) if not _is_declared(name, unstored)
    ]
    wrong += [
        f"{name}: not recorded" for name in sorted(ours.keys() - theirs.keys()) if id(state[name]) not in present
    ]
    wrong += [
        f"{name}: {ours[name]}, recorded {theirs[name]}"
        for name in sorted(ours.keys() & theirs.keys())
        if ours[name] != theirs[name]
    ]
    return wrong


def _read_key_list(file: Path) -> dict[str, Any]:
    """Return the `keys` of a list, each with shape and dtype.

    Raises:
        UsageError: For anything else.
    """
    if not file.is_file():
        raise UsageError(f"key list {file} does not exist")
    try:
        content = load_gzipped_json(file) if file.suffix == ".gz" else load_json(file)
        keys: dict[str, Any] = dict(content["keys"].items())
        for entry in keys.values():
            tuple(entry["shape"]), str(entry["dtype"])
    except (OSError, EOFError, zlib.error, ValueError, KeyError, TypeError, AttributeError) as why:
        raise UsageError(
            f"{file} is no key list ({in_words(why)}); expected JSON with `keys`: name, then shape and dtype"
        ) from why
    return keys


def _is_declared(name: str, declared: tuple[str, ...]) -> bool:
    """Whether `name` is one of `declared`, or begins with one that ends in a dot."""
    return any(name == entry or (entry.endswith(".") and name.startswith(entry)) for entry in declared)


def _describe(tensor: "Tensor") -> Described:
    return tuple(tensor.shape), str(tensor.dtype).removeprefix("torch.")
