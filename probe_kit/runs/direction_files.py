"""Directions from outside: vectors in safetensors or npz files, and the decoders of sparse autoencoders.

A file holds arrays (D,) or (K, D) of finite real numbers by name. The entry `directions` has, as JSON by name, the
site, the role, the space and the hash of the weights. In safetensors it is metadata, in npz an array of one text.
A direction in the space `standardised` has an array NAME.scale (D,), by which it is multiplied. SAELens writes
folders with `sae_weights.safetensors` and `cfg.json`; there NAME is the number of a feature, whose row of the
decoder is read.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import UNREADABLE, check_no_pointer, open_arrays, parse_json, read_json_object
from probe_kit._system.counting import plural
from probe_kit._system.table_cells import is_count
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import Site, role_of_view

ENTRY = "directions"
SUFFIXES = (".safetensors", ".npz")
SAE_WEIGHTS, SAE_SETTINGS, DECODER = "sae_weights.safetensors", "cfg.json", "W_dec"
Space = Literal["raw", "standardised"]
BFLOAT16_ROUNDING = 2.0**-7
_SITE_KEYS = ("site", "hook_name")
"""The keys by which `cfg.json` may name the site: ours, and the one that SAELens writes."""


@dataclass(frozen=True)
class FileDirection:
    """Vectors of a file in the raw space of a site.

    Attributes:
        name: The name in conditions, which contains a hash of the vectors.
        vectors: (K, D) float64.
        site: The site that the file names; empty where it names none.
        role: The role of the tokens; empty where the file names none.
        weights: The hash of the weights that the direction was found in; empty where the file names none.
        rounding: The relative rounding of the file's numbers: rows that differ by less are one direction.
    """

    name: str
    vectors: NDArray[np.float64] = field(repr=False)
    site: str = ""
    role: str = ""
    weights: str = ""
    rounding: float = float(np.finfo(np.float32).eps)

    @cached_property
    def basis(self) -> NDArray[np.float32]:
        """The orthonormal rows (R, D) that span the vectors: R = K, or fewer where rows depend on each other.

        By a QR decomposition; of dependent rows the first R right singular vectors. A QR decomposition would fill
        the rest with arbitrary directions.
        """
        unit = self.vectors / np.linalg.norm(self.vectors, axis=1, keepdims=True)
        _, values, rows = np.linalg.svd(unit, full_matrices=False)
        rank = int((values > self.rounding * values[0]).sum())
        spanning = np.linalg.qr(self.vectors.T)[0].T if rank == len(self.vectors) else rows[:rank]
        return np.asarray(spanning, np.float32)

    @property
    def note(self) -> str:
        """A sentence on rows that depend on each other; empty where none do."""
        count, rank = len(self.vectors), len(self.basis)
        if rank == count:
            return ""
        return (
            f"the {count} rows of {self.name} depend on each other and span {plural(rank, 'direction')}; tokens "
            "are patched within these alone"
        )

    def check(self, site: str, width: int, weights: str | None) -> None:
        """Raise UsageError for a site of another name or width, or for other weights."""
        if self.site and self.site != site:
            raise UsageError(
                f"{self.name} is a direction of {self.site}; it cannot be used at {site}. Name that site"
            )
        if self.vectors.shape[1] != width:
            raise UsageError(f"{self.name} has {self.vectors.shape[1]} numbers; {site} has {width}")
        if self.weights and self.weights != weights:
            raise UsageError(
                f"{self.name} was found in the weights {self.weights[:12]}; the run has {str(weights)[:12]}. Take "
                "a direction of this model"
            )


def names_file(direction: str) -> bool:
    """Whether a direction is spelled as FILE or FILE#NAME."""
    path = Path(direction.partition("#")[0])
    return path.suffix in SUFFIXES or (path / SAE_WEIGHTS).is_file()


def read_direction(text: str) -> FileDirection:
    """Read FILE#NAME; a file of one direction needs no name. Raises UsageError for what holds no direction."""
    file, _, name = text.partition("#")
    path = Path(file).expanduser()
    if (path / SAE_WEIGHTS).is_file():
        return _autoencoder_feature(path, name)
    if not path.is_file():
        raise UsageError(f"--direction {text}: there is no file {path}; expected safetensors or npz")
    arrays, entries = _contents(path)
    names = [array for array in arrays if not array.endswith(".scale")]
    if name not in names:
        if name or len(names) != 1:
            raise UsageError(
                f"--direction {text}: {path.name} has the directions {', '.join(names[:10]) or 'none'}; expected "
                f"one of them behind #"
            )
        (name,) = names
    about = entries.get(name, {})
    space = about.get("space", "raw")
    if space not in ("raw", "standardised"):
        raise UsageError(f"--direction {text}: the space is {space!r}; expected raw or standardised")
    vectors = _rows(arrays[name], text)
    if space == "standardised":
        if f"{name}.scale" not in arrays:
            raise UsageError(f"--direction {text}: a standardised direction needs the array {name}.scale")
        scale = _rows(arrays[f"{name}.scale"], f"{text}, {name}.scale")
        if scale.shape != (1, vectors.shape[1]):
            raise UsageError(
                f"--direction {text}: {name}.scale has the shape {arrays[f'{name}.scale'].shape}; expected "
                f"({vectors.shape[1]},), a number for each of the direction's"
            )
        vectors = _rows(vectors * scale, text)
    return _direction(name, vectors, about, _rounding(arrays[name]))


def write_directions(
    path: Path, vectors: Mapping[str, NDArray[Any]], about: Mapping[str, Mapping[str, str]]
) -> None:
    """Write directions as `read_direction` reads them.

    Args:
        path: A file with an ending of `SUFFIXES`.
        vectors: (D,) or (K, D) by name; stored as float32.
        about: The entry of each direction, by name: site, role, space and hash of the weights.
    """
    check_direction_file(path)
    arrays = {name: np.ascontiguousarray(values, np.float32) for name, values in vectors.items()}
    if path.suffix == ".safetensors":
        from safetensors.numpy import save_file

        save_file(arrays, path, {ENTRY: json.dumps(about)})
    else:
        np.savez(path, allow_pickle=False, **{ENTRY: np.array(json.dumps(about))}, **arrays)


def about_direction(category: str, view: str, site: Site, weights: str | None) -> tuple[str, dict[str, str]]:
    """Return the name of a direction of a category, view and site, and its entry in a file."""
    name = place_name(str(site))
    role = role_of_view(view) or ""  # the last token plays no role of its own
    return f"{category}.{view}.{name}", {"site": name, "role": role, "space": "raw", "weights": weights or ""}


def place_name(site: str) -> str:
    """Return a site as interventions name it, without the residual stream's name."""
    return site.replace(".residual", "")


def check_direction_file(path: Path) -> None:
    """Raise UsageError for a file name that directions are not written to."""
    if path.suffix not in SUFFIXES:
        raise UsageError(f"{path} is no file of directions; expected the ending {' or '.join(SUFFIXES)}")


def _contents(path: Path) -> tuple[dict[str, NDArray[Any]], Mapping[str, Mapping[str, str]]]:
    """Return arrays by name, and the entry of each."""
    from safetensors import SafetensorError, safe_open

    check_no_pointer(path)
    try:
        if path.suffix == ".npz":
            with open_arrays(path) as opened:
                arrays = {name: np.asarray(opened[name]) for name in opened}
            entry_text = str(arrays.pop(ENTRY, "{}"))
        else:
            # Read by torch: numpy has no bfloat16, in which autoencoders of large models are stored.
            with safe_open(path, "pt") as opened:
                arrays = {name: _as_numpy(opened.get_tensor(name)) for name in opened.keys()}  # noqa: SIM118
                entry_text = (opened.metadata() or {}).get(ENTRY, "{}")
        entry = parse_json(entry_text)
        if not isinstance(entry, dict) or not all(isinstance(about, dict) for about in entry.values()):
            raise ValueError(f"its entry {ENTRY!r} is {entry_text[:50]!r}; expected an object of objects")
        return arrays, entry
    except SafetensorError as error:
        raise UsageError(f"{path} is no safetensors file: {str(error)[:200]}") from error
    except (*UNREADABLE, TypeError) as error:
        raise UsageError(f"{path} holds no directions: {str(error)[:200]}") from error


def _as_numpy(tensor: Any) -> NDArray[Any]:
    """Return a tensor as an array; one of bfloat16, which numpy has no type for, as float32."""
    import torch

    return np.asarray((tensor.float() if tensor.dtype == torch.bfloat16 else tensor).numpy())


def _rounding(values: NDArray[Any]) -> float:
    """Return the relative rounding of stored numbers, at least float32's; of float32 that fit bfloat16, its."""
    if values.dtype == np.float32 and not (np.ascontiguousarray(values).view(np.uint32) & 0xFFFF).any():
        return BFLOAT16_ROUNDING
    least = float(np.finfo(np.float32).eps)
    return max(least, float(np.finfo(values.dtype).eps)) if values.dtype.kind == "f" else least


def _autoencoder_feature(folder: Path, name: str) -> FileDirection:
    """Return one feature of a sparse autoencoder that SAELens wrote."""
    arrays, _ = _contents(folder / SAE_WEIGHTS)
    decoder = arrays.get(DECODER, np.empty((0, 0)))
    count = len(decoder) if decoder.ndim == 2 else 0
    if not is_count(name) or int(name) >= count:
        raise UsageError(f"{folder} has {count} features; expected {folder.name}#NUMBER, counted from 0")
    settings = folder / SAE_SETTINGS
    remedy = "Save the autoencoder again with SAELens"
    stored = read_json_object(settings, UsageError, remedy) if settings.exists() else {}
    metadata = stored.get("metadata") or {}
    if not isinstance(metadata, dict):
        raise UsageError(f"{settings} has the metadata {str(metadata)[:50]!r}; expected an object. {remedy}")
    about = {
        "site": next(
            (str(record[key]) for record in (stored, metadata) for key in _SITE_KEYS if record.get(key)), ""
        )
    }
    about["weights"] = str(metadata.get("weights") or "")
    row = decoder[int(name)]
    return _direction(f"feature-{name}", _rows(row, folder.name), about, _rounding(row))


def _rows(values: NDArray[Any], text: str) -> NDArray[np.float64]:
    """Return vectors (K, D), in memory of their own.

    Raises:
        UsageError: For other numbers than real ones, another shape, NaN, infinity and rows of zeros.
    """
    if values.dtype.kind not in "fiu":
        raise UsageError(f"--direction {text}: an array of {values.dtype}; expected real numbers")
    rows = np.atleast_2d(np.array(values, np.float64))
    if rows.ndim != 2 or 0 in rows.shape:
        raise UsageError(f"--direction {text}: an array of shape {np.shape(values)}; expected (D,) or (K, D)")
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(rows, axis=1)
    if not np.isfinite(rows).all() or (lengths == 0).any():
        raise UsageError(f"--direction {text}: it has NaN, infinity or a row of zeros; expected directions")
    if lengths.min() < (limits := np.finfo(np.float32)).tiny or lengths.max() > limits.max:
        raise UsageError(
            f"--direction {text}: its rows are {lengths.min():.3g} to {lengths.max():.3g} long; activations are "
            f"float32, of {limits.tiny:.3g} to {limits.max:.3g}"
        )
    return rows


def _direction(
    name: str, vectors: NDArray[np.float64], about: Mapping[str, Any], rounding: float
) -> FileDirection:
    digest = hashlib.sha256(np.ascontiguousarray(vectors).tobytes()).hexdigest()[:8]
    plain = "".join(letter if letter.isalnum() or letter in "-." else "-" for letter in name)
    # A hash in the name: directions of one name in two files, or of a changed file, stay apart in results.
    parts = {part: str(about.get(part) or "") for part in ("site", "role", "weights")}
    parts["site"] = place_name(parts["site"])
    return FileDirection(f"{plain}-{digest}", vectors, **parts, rounding=rounding)
