"""Conditions of served episodes: named lists of edits, of which each episode gets one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit._system.bounded_files import read_json_object
from probe_kit._system.escaping import UNSAFE
from probe_kit.errors import ProbeKitError, UsageError
from probe_kit.extract.parts import read_edit
from probe_kit.hooks.capturing.edits import Edit, Vectors, vector_hash
from probe_kit.hooks.contract.sites import plays
from probe_kit.runs.direction_files import FileDirection, names_file, place_name, read_direction
from probe_kit.runs.layout import UNEDITED

if TYPE_CHECKING:
    from probe_kit.hooks import Model

LONGEST_NAME = 40
_PART = "edits"
_EXAMPLE = (
    '{"edits": [{"kind": "add", "sites": ["backbone.02.residual"], "roles": ["language"], '
    '"vector": "directions.safetensors#NAME", "strength": 1.0}]}'
)


@dataclass(frozen=True)
class ServedCondition:
    """A named list of edits, which are made at every inference of an episode.

    Attributes:
        name: The name in tables; `none` for no edits.
        edits: The edits, as `ActTask.edits` has them.
        directions: The directions that the edits name, by `vector_hash` of the vector that is used: the sum of the
            rows of the file, as `intervene --kind steer` takes it. Empty for a condition of a stored run, which
            holds hashes alone.
    """

    name: str
    edits: tuple[Edit, ...] = ()
    directions: Mapping[str, FileDirection] = field(default_factory=dict, compare=False, repr=False)

    @property
    def vectors(self) -> Vectors:
        """The vectors (D,) float32 of the edits, by hash."""
        return {name: _vector(direction) for name, direction in self.directions.items()}

    def to_json(self) -> dict[str, Any]:
        """Return plain values, which identify the condition: edits name their vectors by hash."""
        return {"name": self.name, _PART: [edit.to_json() for edit in self.edits]}

    def check(self, model: "Model", weights: str | None) -> None:
        """Compare the edits with a model, which may be one without weights.

        Args:
            model: The model, or its outline.
            weights: The hash of the weights; None before they are loaded.

        Raises:
            UsageError: For a site or role that the model lacks, and for a direction of another width, site or
                other weights or none at all.
        """
        for edit in self.edits:
            if edit.vector and edit.vector not in self.directions:
                raise UsageError(
                    f"--condition {self.name}: no array of the vector {edit.vector[:12]} is given, and no run "
                    "stores it; name the file of edits again"
                )
            for site in edit.sites:
                try:
                    stream = model.stream_of(site)
                except ProbeKitError as error:
                    raise UsageError(f"--condition {self.name}: {error}") from error
                names = model.role_names.get(site.stream)
                if names is None:
                    raise UsageError(
                        f"--condition {self.name}: {site} has no token roles, so that no token can be chosen in it"
                    )
                if strange := [role for role in edit.roles or () if not any(plays(name, role) for name in names)]:
                    raise UsageError(
                        f"--condition {self.name}: no token of {site.stream} plays the role {strange[0]!r}; "
                        f"expected one of {', '.join(names)}"
                    )
                if (direction := self.directions.get(edit.vector)) is not None:
                    weights_here = direction.weights if weights is None else weights
                    direction.check(place_name(str(site)), stream.width, weights_here)


def read_conditions(value: Any) -> tuple[ServedCondition, ...]:
    """Return conditions from NAME=FILE texts of a command line, or from the plain values of stored settings.

    Raises:
        UsageError: For a name that comes twice, and for what is no condition.
    """
    texts = [value] if isinstance(value, str | Mapping | ServedCondition) else list(value or ())
    conditions = tuple(_condition(entry) for entry in texts)
    names = [condition.name for condition in conditions]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"--condition {twice[0]} is given twice; give each once")
    return conditions


def _condition(value: Any) -> ServedCondition:
    if isinstance(value, ServedCondition):
        return value
    if isinstance(value, Mapping):
        return ServedCondition(value["name"], tuple(read_edit(entry) for entry in value[_PART]))
    name, equals, file = str(value).partition("=")
    if not name.strip() or len(name) > LONGEST_NAME or UNSAFE.search(name):
        raise UsageError(f"--condition {value!r:.80}; expected {UNEDITED}, or NAME=FILE with a file of edits")
    if (name == UNEDITED) == bool(equals):
        why = f"{UNEDITED} is the condition without edits" if equals else "a condition has a file of edits"
        raise UsageError(f"--condition {value!r:.80}: {why}; expected --condition {UNEDITED}, or NAME=FILE")
    return ServedCondition(name) if name == UNEDITED else _read(name, Path(file).expanduser())


def _read(name: str, path: Path) -> ServedCondition:
    """Return the condition of a file, with its directions."""
    where = f"--condition {name}={path}"
    if not path.is_file():
        raise UsageError(f"{where}: there is no such file; write edits such as {_EXAMPLE}")
    stored = read_json_object(path, UsageError, f"Write edits such as {_EXAMPLE}")
    entries = stored.get(_PART)
    if stored.keys() != {_PART} or not isinstance(entries, list) or not entries:
        raise UsageError(f"{where} holds no list of edits and nothing else; expected {_EXAMPLE}")
    edits, directions = list[Edit](), dict[str, FileDirection]()
    for number, entry in enumerate(entries, start=1):
        try:
            edit, direction = _edit(entry, path.parent)
        except (TypeError, ValueError, AttributeError, KeyError, ProbeKitError) as error:
            raise UsageError(f"{where}, edit {number}: {error}") from error
        edits.append(edit)
        directions |= {} if direction is None else {edit.vector: direction}
    return ServedCondition(name, tuple(edits), directions)


def _edit(entry: Any, folder: Path) -> tuple[Edit, FileDirection | None]:
    """Return an edit of a file, and the direction that it names."""
    if not isinstance(entry, Mapping):
        raise TypeError(f"it is a {type(entry).__name__}; expected an object such as {_EXAMPLE}")
    if isinstance(entry.get("sites"), str) or isinstance(entry.get("roles"), str):
        raise TypeError("sites and roles are lists of texts")
    vector = entry.get("vector") or ""
    if not vector:
        return read_edit(entry), None
    if entry.get("kind") == "replace":
        raise UsageError("replace needs the tokens of another inference, which no file of directions has")
    if not isinstance(vector, str) or not names_file(str(folder / vector)):
        raise UsageError(f"the vector is {vector!r:.80}; expected FILE#NAME of a safetensors or npz file")
    direction = read_direction(str(folder / vector))
    if entry.get("kind") == "remove" and len(direction.vectors) > 1:
        raise UsageError(f"remove takes one direction; {direction.name} has {len(direction.vectors)} rows")
    return read_edit({**entry, "vector": vector_hash(_vector(direction))}), direction


def _vector(direction: FileDirection) -> Any:
    return direction.vectors.sum(axis=0).astype(np.float32)


def next_condition(names: Sequence[str], counts: Mapping[str, int], order: Sequence[int]) -> str:
    """Return the next condition of a block: the first, in the block's order, of those that came least often.

    Args:
        names: All conditions.
        counts: How often each came in the group so far.
        order: The drawn order of the block, as positions in `names`.
    """
    least = min(counts.get(name, 0) for name in names)
    return next(names[at] for at in order if counts.get(names[at], 0) == least)
