"""Fields of `config.json` that the installed lerobot does not know: accepted where they do nothing."""

from collections.abc import Collection, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from probe_kit.errors import CheckpointError

Inert = Mapping[str, tuple[Any, ...] | None]
"""Fields of a newer lerobot by name, with the values under which inference is as without them; None for any."""
_DELTAS = "observation_delta_indices"


def known_values(
    values: Mapping[str, Any],
    read_fields: Collection[str],
    inert: Inert,
    unread: Collection[str],
    source: Path,
    waived: bool = False,
) -> dict[str, Any]:
    """`values` without the fields that do nothing here.

    read_fields: fields that the installed lerobot reads. inert: of a newer one. unread: those that the caller says
    change nothing. waived: whether users can say so, with -M unread.
    Raises CheckpointError naming every other field that lerobot does not know, and its value.
    """
    extra = {name: value for name, value in values.items() if name not in read_fields and name not in unread}
    changing = {
        name: inert[name] for name, value in extra.items() if name in inert and not _is_inert(value, inert[name])
    }
    if changing:
        requested = ", ".join(f"{name}: {extra[name]!r}" for name in changing)
        plain = ", ".join(
            f"{name}: {' or '.join(map(repr, inert_values or ()))}" for name, inert_values in changing.items()
        )
        raise CheckpointError(
            f"{source} asks for {requested}, which a newer lerobot does in its inference and probe_kit does not. "
            f"Supported is {plain}: take a checkpoint that was trained so"
        )
    if unknown := sorted(set(extra) - set(inert)):
        listed = ", ".join(f"{name}: {extra[name]!r}" for name in unknown)
        way_out = (
            f"accept them with -M unread={','.join(unknown)}" if waived else "remove them from a copy of the file"
        )
        raise CheckpointError(
            f"{source} has unknown settings: {listed}. lerobot {version('lerobot')} does not read them. If they "
            f"change nothing that a picture, a state or an action depends on, {way_out}"
        )
    return {name: value for name, value in values.items() if name in read_fields}


def _is_inert(value: Any, plain: tuple[Any, ...] | None) -> bool:
    """Whether a value is one of these; True is not 1 here."""
    return plain is None or any(value == candidate and type(value) is type(candidate) for candidate in plain)


def check_one_frame(config: Any, folder: Path) -> None:
    """Raise CheckpointError for a policy that reads several observations: every inference here is given one."""
    if (frames := int(getattr(config, "n_obs_steps", 1))) != 1:
        raise CheckpointError(
            f"{folder} reads the last {frames} observations (n_obs_steps); every inference here is given one. "
            "Take a checkpoint with n_obs_steps 1"
        )
    for name in (name for name in dir(type(config)) if name.endswith(_DELTAS)):
        frames = getattr(config, name)
        if frames is not None and list(frames) != [0]:
            raise CheckpointError(
                f"{folder} reads observations of the steps {list(frames)} ({name}); every inference here is given "
                "that of step 0. Take a checkpoint that reads one"
            )
