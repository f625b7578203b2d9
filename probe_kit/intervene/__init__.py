"""Interventions change what a policy sees or carries, and nothing else: is decodable information also used?

They need the run's policy and pictures again. Stored results need neither to be read.
"""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names

if TYPE_CHECKING:
    from probe_kit.intervene.kinds.attention import (
        AttentionReadout,
        AttentionRow,
        AttentionShares,
        stored_attention,
    )
    from probe_kit.intervene.kinds.attribution import AttributionPatching
    from probe_kit.intervene.kinds.closed_loop import ClosedLoop, ClosedLoopEffect
    from probe_kit.intervene.kinds.erase import ConceptErasure, ErasureEffect
    from probe_kit.intervene.kinds.image_swap import ImageSwap, ImageSwapEffect, stored_image_swaps
    from probe_kit.intervene.kinds.instruction_swap import InputSensitivity, InstructionSwap, InstructionSwapEffect
    from probe_kit.intervene.kinds.interchange import (
        Interchange,
        PatchEffect,
        best_patch_targets,
        stored_site_effects,
    )
    from probe_kit.intervene.kinds.joint import JointEffect, JointPlaces, stored_joint_places
    from probe_kit.intervene.kinds.knockout import Knockout, KnockoutEffect
    from probe_kit.intervene.kinds.steer import Steering
    from probe_kit.intervene.outcomes import ConditionOutcomes
    from probe_kit.intervene.patching.attribution import AttributionEffect
    from probe_kit.intervene.results import InterventionResult, load_effects
    from probe_kit.intervene.runner import run_intervention
    from probe_kit.intervene.sessions import ReplayFiles, ReplaySession
    from probe_kit.intervene.stored import stored_interventions
    from probe_kit.intervene.verdict import Behaviour, Places, UseVerdict, classify_all, classify_use
    from probe_kit.intervene.vocabulary import ValueWords, WordMatch, value_words
    from probe_kit.runs.direction_files import write_directions

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
    "Knockout",
    "KnockoutEffect",
    "PatchEffect",
    "Places",
    "ReplayFiles",
    "ReplaySession",
    "Steering",
    "UseVerdict",
    "ValueWords",
    "WordMatch",
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
    "value_words",
    "write_directions",
]

# `probe-kit --help` and tables that only read must load neither torch nor a simulator.
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "InputSensitivity": "kinds.instruction_swap",
        "InstructionSwapEffect": "kinds.instruction_swap",
        "InstructionSwap": "kinds.instruction_swap",
        "stored_site_effects": "kinds.interchange",
        "PatchEffect": "kinds.interchange",
        "Steering": "kinds.steer",
        "AttributionEffect": "patching.attribution",
        "AttributionPatching": "kinds.attribution",
        "Interchange": "kinds.interchange",
        "ConditionOutcomes": "outcomes",
        "AttentionRow": "kinds.attention",
        "AttentionReadout": "kinds.attention",
        "AttentionShares": "kinds.attention",
        "stored_attention": "kinds.attention",
        "ReplaySession": "sessions",
        "ClosedLoopEffect": "kinds.closed_loop",
        "ClosedLoop": "kinds.closed_loop",
        "best_patch_targets": "kinds.interchange",
        "InterventionResult": "results",
        "ConceptErasure": "kinds.erase",
        "ErasureEffect": "kinds.erase",
        "ImageSwap": "kinds.image_swap",
        "ImageSwapEffect": "kinds.image_swap",
        "UseVerdict": "verdict",
        "ReplayFiles": "sessions",
        "Behaviour": "verdict",
        "JointEffect": "kinds.joint",
        "JointPlaces": "kinds.joint",
        "Knockout": "kinds.knockout",
        "KnockoutEffect": "kinds.knockout",
        "Places": "verdict",
        "stored_joint_places": "kinds.joint",
        "run_intervention": "runner",
        "classify_use": "verdict",
        "classify_all": "verdict",
        "load_effects": "results",
        "stored_image_swaps": "kinds.image_swap",
        "stored_interventions": "stored",
        "value_words": "vocabulary",
        "ValueWords": "vocabulary",
        "WordMatch": "vocabulary",
        "write_directions": "probe_kit.runs.direction_files",
    },
)
