"""The checks of each kind of model."""

from collections.abc import Sequence

from probe_kit.hooks.conformance import (
    acting,
    answering,
    batches,
    editing,
    gradients,
    heads,
    interventions,
    loading,
    sites,
    token_roles,
)
from probe_kit.hooks.conformance.check import Check, checks_of

MODEL_CHECKS: Sequence[Check] = checks_of(sites, editing, heads, batches, token_roles, loading)
POLICY_CHECKS: Sequence[Check] = (*MODEL_CHECKS, *checks_of(acting, interventions, gradients))
ANSWER_CHECKS: Sequence[Check] = (*MODEL_CHECKS, *checks_of(answering))
