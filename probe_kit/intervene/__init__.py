"""Interventions: is what can be read also used? Changes what a policy sees or carries, and nothing else.

Needs the run's policy and pictures again; what is stored needs neither to be read.
"""

from typing import TYPE_CHECKING

from probe_kit._system.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.intervene.kinds.attention.attention_mass import AttentionRow, AttentionShares, stored_attention
    from probe_kit.intervene.kinds.attention.intervention import AttentionReadout
    from probe_kit.intervene.kinds.attribution.effects import AttributionEffect
    from probe_kit.intervene.kinds.attribution.intervention import AttributionPatching
    from probe_kit.intervene.kinds.closed_loop.effects import ClosedLoopEffect
    from probe_kit.intervene.kinds.closed_loop.intervention import ClosedLoop
    from probe_kit.intervene.kinds.erase import ConceptErasure, ErasureEffect
    from probe_kit.intervene.kinds.image_swap.effects import ImageSwapEffect, stored_image_swaps
    from probe_kit.intervene.kinds.image_swap.intervention import ImageSwap
    from probe_kit.intervene.kinds.image_swap.verdict import (
        Behaviour,
        Places,
        UseVerdict,
        classify_all,
        classify_use,
    )
    from probe_kit.intervene.kinds.instruction_swap.effects import InputSensitivity, InstructionSwapEffect
    from probe_kit.intervene.kinds.instruction_swap.intervention import InstructionSwap
    from probe_kit.intervene.kinds.interchange.intervention import Interchange
    from probe_kit.intervene.kinds.joint.effects import JointEffect, stored_joint_places
    from probe_kit.intervene.kinds.joint.intervention import JointPlaces
    from probe_kit.intervene.kinds.site_effects import PatchEffect
    from probe_kit.intervene.kinds.steer.intervention import Steering
    from probe_kit.intervene.replay.session import ReplaySession, ReplaySource
    from probe_kit.intervene.results.best_targets import best_patch_targets
    from probe_kit.intervene.results.results import InterventionResult, load_effects
    from probe_kit.intervene.results.site_maps import stored_site_effects
    from probe_kit.intervene.runner import run_intervention
    from probe_kit.intervene.store.answers import ConditionOutcomes, stored_interventions

__all__ = [
    "AttentionReadout",
    "AttentionRow",
    "AttentionShares",
    "AttributionEffect",
    "AttributionPatching",
    "Behaviour",
    "ClosedLoop",
    "ClosedLoopEffect",
    "ConceptErasure",
    "ConditionOutcomes",
    "ErasureEffect",
    "ImageSwap",
    "ImageSwapEffect",
    "InputSensitivity",
    "InstructionSwap",
    "InstructionSwapEffect",
    "Interchange",
    "InterventionResult",
    "JointEffect",
    "JointPlaces",
    "PatchEffect",
    "Places",
    "ReplaySession",
    "ReplaySource",
    "Steering",
    "UseVerdict",
    "best_patch_targets",
    "classify_all",
    "classify_use",
    "load_effects",
    "run_intervention",
    "stored_attention",
    "stored_image_swaps",
    "stored_interventions",
    "stored_joint_places",
    "stored_site_effects",
]

# `probe-kit --help` and tables that only read must load neither torch nor a simulator.
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "InputSensitivity": "kinds.instruction_swap.effects",
        "InstructionSwapEffect": "kinds.instruction_swap.effects",
        "InstructionSwap": "kinds.instruction_swap.intervention",
        "stored_site_effects": "results.site_maps",
        "PatchEffect": "kinds.site_effects",
        "Steering": "kinds.steer.intervention",
        "AttributionEffect": "kinds.attribution.effects",
        "AttributionPatching": "kinds.attribution.intervention",
        "Interchange": "kinds.interchange.intervention",
        "ConditionOutcomes": "store.answers",
        "AttentionRow": "kinds.attention.attention_mass",
        "AttentionReadout": "kinds.attention.intervention",
        "AttentionShares": "kinds.attention.attention_mass",
        "stored_attention": "kinds.attention.attention_mass",
        "ReplaySession": "replay.session",
        "ClosedLoopEffect": "kinds.closed_loop.effects",
        "ClosedLoop": "kinds.closed_loop.intervention",
        "best_patch_targets": "results.best_targets",
        "InterventionResult": "results.results",
        "ConceptErasure": "kinds.erase",
        "ErasureEffect": "kinds.erase",
        "ImageSwap": "kinds.image_swap.intervention",
        "ImageSwapEffect": "kinds.image_swap.effects",
        "UseVerdict": "kinds.image_swap.verdict",
        "ReplaySource": "replay.session",
        "Behaviour": "kinds.image_swap.verdict",
        "JointEffect": "kinds.joint.effects",
        "JointPlaces": "kinds.joint.intervention",
        "Places": "kinds.image_swap.verdict",
        "stored_joint_places": "kinds.joint.effects",
        "run_intervention": "runner",
        "classify_use": "kinds.image_swap.verdict",
        "classify_all": "kinds.image_swap.verdict",
        "load_effects": "results.results",
        "stored_image_swaps": "kinds.image_swap.effects",
        "stored_interventions": "store.answers",
    },
)
