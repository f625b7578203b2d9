"""The checks of each kind of model."""

from collections.abc import Mapping, Sequence

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
from probe_kit.hooks.conformance.subject import AnswerSubject, PolicySubject, Subject

_MODEL_CHECKS = checks_of(sites, editing, heads, batches, token_roles, loading)
POLICY_CHECKS: Sequence[Check] = (*_MODEL_CHECKS, *checks_of(acting, interventions, gradients))
ANSWER_CHECKS: Sequence[Check] = (*_MODEL_CHECKS, *checks_of(answering))
CONTRACTS: Mapping[type[Subject], Sequence[Check]] = {PolicySubject: POLICY_CHECKS, AnswerSubject: ANSWER_CHECKS}
