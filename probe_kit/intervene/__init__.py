"""Interventions: is what can be read also used? Changes what a policy sees or carries, and nothing else.

Needs the run's policy and pictures again; what is stored needs neither to be read.
"""

from typing import TYPE_CHECKING

from probe_kit._system.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.intervene.kinds.attention.attention_mass import Attending, Weighed, stored_attention
    from probe_kit.intervene.kinds.attention.intervention import Attention
    from probe_kit.intervene.kinds.closed_loop.effects import CarriedOut
    from probe_kit.intervene.kinds.closed_loop.intervention import ClosedLoop
    from probe_kit.intervene.kinds.erase.effects import Erasing
    from probe_kit.intervene.kinds.erase.intervention import Erase
    from probe_kit.intervene.kinds.image_swap.effects import Following, stored_following
    from probe_kit.intervene.kinds.image_swap.intervention import Follow
    from probe_kit.intervene.kinds.image_swap.verdict import Judgement, Verdict, judge, judgements
    from probe_kit.intervene.kinds.instruction_swap.effects import Sensitivity
    from probe_kit.intervene.kinds.instruction_swap.intervention import Words
    from probe_kit.intervene.kinds.interchange.intervention import Interchange
    from probe_kit.intervene.kinds.site_effects import Passing
    from probe_kit.intervene.kinds.steer.intervention import Steer
    from probe_kit.intervene.replay.session import Bench, Source
    from probe_kit.intervene.results.best_targets import best_cells
    from probe_kit.intervene.results.results import Effects, load_effects
    from probe_kit.intervene.results.site_maps import stored_passing
    from probe_kit.intervene.runner import intervene_on
    from probe_kit.intervene.store.answers import Answers, stored_interventions

__all__ = [
    "Answers",
    "Attending",
    "Attention",
    "Bench",
    "CarriedOut",
    "ClosedLoop",
    "Effects",
    "Erase",
    "Erasing",
    "Follow",
    "Following",
    "Interchange",
    "Judgement",
    "Passing",
    "Sensitivity",
    "Source",
    "Steer",
    "Verdict",
    "Weighed",
    "Words",
    "best_cells",
    "intervene_on",
    "judge",
    "judgements",
    "load_effects",
    "stored_attention",
    "stored_following",
    "stored_interventions",
    "stored_passing",
]

# `probe-kit --help` and tables that only read must load neither torch nor a simulator.
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Sensitivity": "kinds.instruction_swap.effects",
        "Words": "kinds.instruction_swap.intervention",
        "stored_passing": "results.site_maps",
        "Passing": "kinds.site_effects",
        "Steer": "kinds.steer.intervention",
        "Interchange": "kinds.interchange.intervention",
        "Answers": "store.answers",
        "Attending": "kinds.attention.attention_mass",
        "Attention": "kinds.attention.intervention",
        "Weighed": "kinds.attention.attention_mass",
        "stored_attention": "kinds.attention.attention_mass",
        "Bench": "replay.session",
        "CarriedOut": "kinds.closed_loop.effects",
        "ClosedLoop": "kinds.closed_loop.intervention",
        "best_cells": "results.best_targets",
        "Effects": "results.results",
        "Erase": "kinds.erase.intervention",
        "Erasing": "kinds.erase.effects",
        "Follow": "kinds.image_swap.intervention",
        "Following": "kinds.image_swap.effects",
        "Judgement": "kinds.image_swap.verdict",
        "Source": "replay.session",
        "Verdict": "kinds.image_swap.verdict",
        "intervene_on": "runner",
        "judge": "kinds.image_swap.verdict",
        "judgements": "kinds.image_swap.verdict",
        "load_effects": "results.results",
        "stored_following": "kinds.image_swap.effects",
        "stored_interventions": "store.answers",
    },
)
