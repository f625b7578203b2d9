"""Models and the capture of their activations: sites, taps, edits, weights audit, one folder per family."""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names
from probe_kit.hooks.capturing.edits import Edit
from probe_kit.hooks.contract.card import ModelCard
from probe_kit.hooks.contract.declared import Interventions, Option
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.hooks.family import Family
from probe_kit.hooks.family_parts import Abilities, Checkpoints, Requirements
from probe_kit.hooks.registry import known_families, load_model, load_policy

if TYPE_CHECKING:
    from probe_kit.hooks.capturing.attention import (
        AttentionCut,
        AttentionMass,
        attended_roles,
        capture_attention,
        capture_patterns,
        cut_attention,
    )
    from probe_kit.hooks.capturing.capture_context import ActivationCache, capture, edit, gradients_at
    from probe_kit.hooks.capturing.edits import apply_edits
    from probe_kit.hooks.capturing.readouts import LogitLens, logit_lens, project_heads
    from probe_kit.hooks.checkpoints.weights import load_weights, read_weights
    from probe_kit.hooks.contract.model import AnswerModel, Model, Policy, Prompt, Reading, Rows, Tap, Unembedding
    from probe_kit.hooks.contract.roles import Roles, pool

__all__ = [
    "Abilities",
    "ActivationCache",
    "AnswerModel",
    "AttentionCut",
    "AttentionMass",
    "Checkpoints",
    "Edit",
    "Family",
    "Interventions",
    "LogitLens",
    "Model",
    "ModelCard",
    "Observation",
    "Option",
    "Policy",
    "Prompt",
    "Reading",
    "Requirements",
    "Roles",
    "Rows",
    "Site",
    "Stream",
    "Tap",
    "Unembedding",
    "apply_edits",
    "attended_roles",
    "capture",
    "capture_attention",
    "capture_patterns",
    "cut_attention",
    "edit",
    "gradients_at",
    "known_families",
    "load_model",
    "load_policy",
    "load_weights",
    "logit_lens",
    "pool",
    "project_heads",
    "read_weights",
]

# These import torch, which takes seconds; reading a run needs only sites.
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "read_weights": "checkpoints.weights",
        "load_weights": "checkpoints.weights",
        "AttentionCut": "capturing.attention",
        "cut_attention": "capturing.attention",
        "capture_attention": "capturing.attention",
        "AttentionMass": "capturing.attention",
        "capture_patterns": "capturing.attention",
        "attended_roles": "capturing.attention",
        "project_heads": "capturing.readouts",
        "logit_lens": "capturing.readouts",
        "LogitLens": "capturing.readouts",
        "Unembedding": "contract.model",
        "Model": "contract.model",
        "Policy": "contract.model",
        "Prompt": "contract.model",
        "AnswerModel": "contract.model",
        "Reading": "contract.model",
        "Rows": "contract.model",
        "Tap": "contract.model",
        "ActivationCache": "capturing.capture_context",
        "apply_edits": "capturing.edits",
        "gradients_at": "capturing.capture_context",
        "capture": "capturing.capture_context",
        "edit": "capturing.capture_context",
        "Roles": "contract.roles",
        "pool": "contract.roles",
    },
)
