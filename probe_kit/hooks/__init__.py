"""Models and how to listen to them: sites, taps, capture, weights audit, one folder per family."""

from typing import TYPE_CHECKING

from probe_kit.hooks.card import Card
from probe_kit.hooks.edits import Edit
from probe_kit.hooks.family import Family
from probe_kit.hooks.interventions import Interventions
from probe_kit.hooks.observation import Observation
from probe_kit.hooks.options import Option
from probe_kit.hooks.registry import known_families, load_model, load_policy
from probe_kit.hooks.sites import Site, Stream
from probe_kit.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.hooks.attention import AttentionMass
    from probe_kit.hooks.capture_context import capture, edit
    from probe_kit.hooks.editing import applied
    from probe_kit.hooks.model import Model, Policy, Question, Reader, Reading, Rows, Tap
    from probe_kit.hooks.roles import Roles, pool
    from probe_kit.hooks.tape import Tape

__all__ = [
    "AttentionMass",
    "Card",
    "Edit",
    "Family",
    "Interventions",
    "Model",
    "Observation",
    "Option",
    "Policy",
    "Question",
    "Reader",
    "Reading",
    "Roles",
    "Rows",
    "Site",
    "Stream",
    "Tap",
    "Tape",
    "applied",
    "capture",
    "edit",
    "known_families",
    "load_model",
    "load_policy",
    "pool",
]

# These import torch, which takes seconds; reading a run needs only sites.
__getattr__ = lazy_names(
    __name__,
    {
        "AttentionMass": "attention",
        "Model": "model",
        "Policy": "model",
        "Question": "model",
        "Reader": "model",
        "Reading": "model",
        "Rows": "model",
        "Tap": "model",
        "Tape": "tape",
        "applied": "editing",
        "capture": "capture_context",
        "edit": "capture_context",
        "Roles": "roles",
        "pool": "roles",
    },
)
