"""Models and the capture of their activations: sites, taps, edits, weights audit, one folder per family."""

from typing import TYPE_CHECKING

from probe_kit._system.lazy import lazy_names
from probe_kit.hooks.capturing.edits import Edit
from probe_kit.hooks.contract.card import ModelCard
from probe_kit.hooks.contract.interventions import Interventions
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.options import Option
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.hooks.family import Family
from probe_kit.hooks.registry import known_families, load_model, load_policy

if TYPE_CHECKING:
    from probe_kit.hooks.capturing.activation_cache import ActivationCache
    from probe_kit.hooks.capturing.attention import AttentionMass, capture_attention
    from probe_kit.hooks.capturing.attention_patterns import attended_roles, capture_patterns
    from probe_kit.hooks.capturing.capture_context import capture, edit
    from probe_kit.hooks.capturing.edit_engine import apply_edits
    from probe_kit.hooks.capturing.gradients import gradients_at
    from probe_kit.hooks.capturing.head_outputs import project_heads
    from probe_kit.hooks.capturing.logit_lens import LogitLens, logit_lens
    from probe_kit.hooks.checkpoints.weights import load_weights, read_weights
    from probe_kit.hooks.contract.model import AnswerModel, Model, Policy, Prompt, Reading, Rows, Tap
    from probe_kit.hooks.contract.roles import Roles, pool
    from probe_kit.hooks.contract.unembedding import Unembedding

__all__ = [
    "ActivationCache",
    "AnswerModel",
    "AttentionMass",
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
        "capture_attention": "capturing.attention",
        "AttentionMass": "capturing.attention",
        "capture_patterns": "capturing.attention_patterns",
        "attended_roles": "capturing.attention_patterns",
        "project_heads": "capturing.head_outputs",
        "logit_lens": "capturing.logit_lens",
        "LogitLens": "capturing.logit_lens",
        "Unembedding": "contract.unembedding",
        "Model": "contract.model",
        "Policy": "contract.model",
        "Prompt": "contract.model",
        "AnswerModel": "contract.model",
        "Reading": "contract.model",
        "Rows": "contract.model",
        "Tap": "contract.model",
        "ActivationCache": "capturing.activation_cache",
        "apply_edits": "capturing.edit_engine",
        "gradients_at": "capturing.gradients",
        "capture": "capturing.capture_context",
        "edit": "capturing.capture_context",
        "Roles": "contract.roles",
        "pool": "contract.roles",
    },
)
