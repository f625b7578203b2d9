"""The number of actions after which an environment ends its episodes, as it or its simulator declares it."""

from collections.abc import Callable, Iterator, Mapping
from numbers import Integral
from typing import Any

from probe_kit.errors import OwnEnvironmentError

MAX_STEPS_NAME = "max_steps"
"""The attribute by which an environment of one's own declares its limit."""
_ATTRIBUTES = ("_max_episode_steps", "max_episode_steps", "horizon", "max_path_length")
"""The attributes by which simulators declare it: wrappers of Gymnasium, lerobot's, robosuite's, Meta-World's."""


def declared_limit(environment: object, name: str) -> int | None:
    """Return the actions after which an environment ends its episodes; None where nothing declares a number.

    It is the attribute `max_steps` of the environment. Without one, it is the largest limit of the simulators that
    are attributes of the environment, alone or in a list or dictionary, and of the environment itself.

    Raises:
        OwnEnvironmentError: For a `max_steps` that is no number of actions.
    """
    typed = getattr(environment, MAX_STEPS_NAME, None)
    if typed is not None and not callable(typed):
        return checked_limit(typed, name)
    limits = [limit for simulator in _simulators(environment) if (limit := limit_of(simulator)) is not None]
    return max(limits, default=None)


def checked_limit(value: object, where: str) -> int:
    """Return a declared number of actions. Raises OwnEnvironmentError for what is none."""
    limit = _actions(value)
    if limit is None:
        raise OwnEnvironmentError(
            f"{where} has the {MAX_STEPS_NAME} {value!r}; expected a number of actions from 1 on, or None"
        )
    return limit


def limit_of(simulator: object) -> int | None:
    """Return the actions after which a simulator ends its episodes; None where it declares no number.

    In this order: what a wrapper of Gymnasium such as `TimeLimit` counts, the `spec` of a registered environment,
    and attributes of other simulators.
    """
    of_wrappers = _attribute(simulator, "get_wrapper_attr")
    values = [
        _quietly(lambda: of_wrappers("_max_episode_steps")),
        _attribute(_attribute(simulator, "spec"), "max_episode_steps"),
        *(_attribute(simulator, name) for name in _ATTRIBUTES),
    ]
    return next((limit for value in values if (limit := _actions(value)) is not None), None)


def _simulators(environment: object) -> Iterator[object]:
    """Yield the environment and what it holds that can be reset and stepped."""
    held = list(getattr(environment, "__dict__", {}).values())
    several = [part for value in held for part in _parts(value)]
    for candidate in (environment, *held, *several):
        if all(callable(_attribute(candidate, name)) for name in ("reset", "step")):
            yield candidate


def _parts(value: object) -> list[Any]:
    if isinstance(value, Mapping):
        return list(value.values())
    return list(value) if isinstance(value, list | tuple) else []


def _actions(value: object) -> int | None:
    is_count = isinstance(value, Integral) and not isinstance(value, bool) and int(value) > 0
    return int(value) if is_count else None  # type: ignore[call-overload]


def _attribute(of: object, name: str) -> Any:
    return _quietly(lambda: getattr(of, name))


def _quietly(read: Callable[[], Any]) -> Any:
    """Return what `read` returns; None where a simulator has no such attribute or fails to give it."""
    try:
        return read()
    except Exception:  # noqa: BLE001 - of code that is not ours
        return None
