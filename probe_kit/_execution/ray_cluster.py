"""Connection to a Ray cluster, and answers of what runs there (extra `ray`)."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from probe_kit._system.optional_dependencies import require
from probe_kit.errors import ProbeKitError, UsageError

AUTO = "auto"
"""The cluster this process belongs to, or else a new one on this machine."""
KNOCK_TIMEOUT = 10.0
"""Seconds in which the head of a cluster has to take a connection."""


@contextmanager
def ray_cluster(address: str, log_to_driver: bool) -> Iterator[Any]:
    """The module `ray`, connected to the cluster at `address` while the body runs.

    A connection that was there before stays. log_to_driver: whether this process prints what workers print.
    Raises MissingExtraError without Ray, and UsageError if nothing answers at the address.
    """
    ray = require("ray", "ray")
    if ray.is_initialized():
        yield ray
        return
    try:
        _knock(address)
        ray.init(
            address=None if address == AUTO else address, include_dashboard=False, log_to_driver=log_to_driver
        )
    except (OSError, ValueError) as error:
        raise UsageError(
            f"no Ray cluster answers at {address!r}: {error}. Start one with `ray start --head`, or give "
            f"{AUTO!r} for a new one on this machine"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def answer_of(ray: Any, call: Any) -> Any:
    """What a finished call returned. Raises an error of ours that it returned, and Ray's own of a lost worker.

    What runs on a cluster returns errors of ours instead of raising them: Ray would wrap them.
    """
    answer = ray.get(call)
    if isinstance(answer, ProbeKitError):
        raise answer
    return answer


def _knock(address: str) -> None:
    """Raise OSError if no server answers: Ray itself tries a dead address for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=KNOCK_TIMEOUT).close()
