"""Policies and how to listen to them: sites, taps, capture, weights audit, one adapter per family."""

from typing import TYPE_CHECKING

from probe_kit.hooks.registry import Family, families, load_policy
from probe_kit.hooks.sites import Site, Stream
from probe_kit.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.hooks.capture_context import Tape, capture, edit
    from probe_kit.hooks.policy import Observation, Policy, PolicyCard, Tap
    from probe_kit.hooks.roles import Roles, pool

__all__ = [
    "Family",
    "Observation",
    "Policy",
    "PolicyCard",
    "Roles",
    "Site",
    "Stream",
    "Tap",
    "Tape",
    "capture",
    "edit",
    "families",
    "load_policy",
    "pool",
]

# These import torch, which takes seconds; reading a run needs only sites.
__getattr__ = lazy_names(
    __name__,
    {
        "Observation": "policy",
        "Policy": "policy",
        "PolicyCard": "policy",
        "Tap": "policy",
        "Tape": "capture_context",
        "capture": "capture_context",
        "edit": "capture_context",
        "Roles": "roles",
        "pool": "roles",
    },
)
