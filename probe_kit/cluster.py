"""Ray, started and stopped in one place (extra `ray`)."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from probe_kit.errors import UsageError
from probe_kit.extras import require

AUTO = "auto"
"""The cluster this process belongs to, or else a new one on this machine."""


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
        ray.init(
            address=None if address == AUTO else address, include_dashboard=False, log_to_driver=log_to_driver
        )
    except (ConnectionError, ValueError) as error:
        raise UsageError(
            f"no Ray cluster answers at {address!r}: {error}. Start one with `ray start --head`, or give "
            f"{AUTO!r} for a new one on this machine"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()
