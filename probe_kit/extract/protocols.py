"""Published protocols: they supply the settings that were not given; given settings take precedence."""

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit.errors import UsageError
from probe_kit.extract.parts import ActTask, ModelSettings, is_here
from probe_kit.extract.sources.source import SourceSettings
from probe_kit.hooks.contract.card import EMBEDDED
from probe_kit.hooks.contract.declared import ACT2ANSWER, PLAIN, ProtocolRow, as_text

if TYPE_CHECKING:
    from probe_kit.env import SceneSpec
    from probe_kit.hooks.family import Family

SCENES: Mapping[str, str] = {ACT2ANSWER: "act2answer"}
"""The scene preset by protocol."""
_OF_ACTING = ("execute", "rotation")


def protocol_scene(protocol: str | None, name: str | None = None, **changes: Any) -> "SceneSpec":
    """Return the preset `name`, else the protocol's, else the default one, with fields replaced.

    Raises:
        UsageError: For an unknown protocol.
        SceneError: For an unknown preset or field.
    """
    from probe_kit.env import SceneSpec

    if protocol is not None:
        check_protocol(protocol)
        name = name or SCENES[protocol]
    return SceneSpec.preset(name or "bridge", **changes)


def scene_of(model: str, protocol: str | None = None, name: str | None = None, **changes: Any) -> "SceneSpec":
    """Return a model's scene: the preset `name`, else the protocol's, else its family's home; fields replaced.

    An unknown family and a scripted policy have the default scene. Errors are those of `protocol_scene`.
    """
    family = None if protocol or name else _family(model)
    from probe_kit.env import SceneSpec

    if family is None:
        return protocol_scene(protocol, name, **changes)
    return SceneSpec.preset(family.home.preset, **{**family.home.changes, **changes})


def has_network(model: str) -> bool:
    """Whether `model` is a family, and no script."""
    return _family(model) is not None


def check_protocol(name: str) -> None:
    """Raise UsageError for an unknown protocol."""
    if name not in SCENES:
        near = get_close_matches(name, SCENES, n=1)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise UsageError(f"unknown protocol {name!r}; available: {', '.join(SCENES)}.{hint}")


def protocol_identity(model: ModelSettings, task: ActTask, source: SourceSettings) -> dict[str, Any]:
    """Return what a run stores of the protocol it follows, under `protocol`; empty without one.

    The entry `variant` names the checkpoint of the protocol, where it has several for the model. The entry
    `differs_from_default` has, by setting, the value of the protocol and the default here. The entry `deviations`
    has the values of the protocol and of the run. The entry `unmatched` lists what cannot be done here.
    """
    if task.protocol is None or "protocol" in source.refuses:
        return {}
    row, used = protocol_row(model, task.protocol), _used_values(model, task, source.scene_spec)
    protocol = {**({} if row is None else row.settings()), **_scene(protocol_scene(task.protocol))}
    default = {**({} if row is None else _defaults(model.family, row)), **_scene(scene_of(model.family))}
    if task.capture_only:
        for name in _OF_ACTING:
            protocol.pop(name, None)
            default.pop(name, None)
    return {
        "protocol": {
            "name": task.protocol,
            **({"variant": row.variant} if row is not None and row.variant else {}),
            "differs_from_default": _list_differences(protocol, default, protocol),
            "deviations": _list_differences(protocol, used, {**used, **protocol}),
            "unmatched": [] if row is None else list(row.unmatched),
        }
    }


def protocol_row(model: ModelSettings, protocol: str | None) -> ProtocolRow | None:
    """Return the protocol's row of a model and checkpoint; None without a protocol, and for scripts.

    With another checkpoint than the protocol's, and with None, it is the row of the model's first.

    Raises:
        UsageError: For a model that the protocol does not use.
    """
    family = _family(model.family)
    if protocol is None or family is None:
        return None
    if protocol not in family.protocols:
        from probe_kit.hooks.registry import known_families

        using = [name for name, candidate in known_families().items() if protocol in candidate.protocols]
        raise UsageError(
            f"the protocol {protocol} does not use {model.family}; it uses {', '.join(using)}. Leave --protocol "
            f"out, and take its scene with --scene {SCENES[protocol]}"
        )
    return family.protocols[protocol].of(model.checkpoint)


def _family(model: str) -> "Family | None":
    from probe_kit.hooks.registry import get_family

    return get_family(model)


def _used_values(model: ModelSettings, task: ActTask, scene: "SceneSpec") -> dict[str, str]:
    """Return the values that the run is made with, under the names of `ProtocolRow.settings`."""
    used = {f"-M {name}": _portable_value(as_text(value)) for name, value in model.options.items()}
    plain = {
        "checkpoint": model.checkpoint, "execute": task.execute, "rotation": task.rotation, "dtype": model.dtype,
    }  # fmt: skip
    used |= {name: _portable_value(str(value)) for name, value in plain.items() if value is not None}
    return {**used, **({"acts": "capture only"} if task.capture_only else {}), **_scene(scene)}


def _portable_value(value: str) -> str:
    """Return only the last name of a file or folder: its place on this machine is no part of a run.

    Other values are returned as they are.
    """
    return Path(value).name if is_here(value) else value


def _defaults(model: str, row: ProtocolRow) -> dict[str, str]:
    """Return the values of the same settings without a protocol, in the words of `probe-kit models`."""
    from probe_kit.hooks.registry import find_family

    family = find_family(model)
    defaults = {f"-M {option.name}": option.default for option in family.options}
    defaults |= {f"-M {name}": as_text(value) for name, value in family.checkpoints.of_default.items()}
    defaults |= {
        "checkpoint": family.default_checkpoint or EMBEDDED,
        "execute": "the checkpoint's",
        "rotation": PLAIN,
        "dtype": "the checkpoint's",
    }
    return {name: defaults[name] for name in row.settings()}


def _scene(scene: "SceneSpec") -> dict[str, str]:
    derived = {"name"} | ({"epsilon"} if scene.epsilon is None else set())
    return {f"scene {name}": as_text(value) for name, value in _leaves(scene.to_json()) if name not in derived}


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _list_differences(
    protocol: Mapping[str, str], other: Mapping[str, str], names: Iterable[str]
) -> dict[str, list[str | None]]:
    return {
        name: [protocol.get(name), other.get(name)]
        for name in dict.fromkeys(names)
        if protocol.get(name) != other.get(name)
    }
