"""Interventions: is what can be read also used? Changes what a policy sees or carries, and nothing else.

Needs the run's policy and pictures again; what is stored needs neither to be read.
"""

from typing import TYPE_CHECKING

from probe_kit.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.intervene.bench import Bench, Source
    from probe_kit.intervene.best_targets import best_cells
    from probe_kit.intervene.carried_out import CarriedOut
    from probe_kit.intervene.closed_loop import ClosedLoop
    from probe_kit.intervene.effects import Effects, load_effects
    from probe_kit.intervene.erase import Erase
    from probe_kit.intervene.erased import Erasing
    from probe_kit.intervene.follow import Follow
    from probe_kit.intervene.following import Following, stored_following
    from probe_kit.intervene.inside import stored_passing
    from probe_kit.intervene.interchange import Interchange
    from probe_kit.intervene.intervening import intervene_on
    from probe_kit.intervene.passing import Passing
    from probe_kit.intervene.sensitivity import Sensitivity
    from probe_kit.intervene.steer import Steer
    from probe_kit.intervene.stored import Answers, stored_interventions
    from probe_kit.intervene.verdict import Judgement, Verdict, judge, judgements
    from probe_kit.intervene.weigh import Attention
    from probe_kit.intervene.weighed import Attending, Weighed, stored_attention
    from probe_kit.intervene.words import Words

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
__getattr__ = lazy_names(
    __name__,
    {
        "Sensitivity": "sensitivity",
        "Words": "words",
        "stored_passing": "inside",
        "Passing": "passing",
        "Steer": "steer",
        "Interchange": "interchange",
        "Answers": "stored",
        "Attending": "weighed",
        "Attention": "weigh",
        "Weighed": "weighed",
        "stored_attention": "weighed",
        "Bench": "bench",
        "CarriedOut": "carried_out",
        "ClosedLoop": "closed_loop",
        "best_cells": "best_targets",
        "Effects": "effects",
        "Erase": "erase",
        "Erasing": "erased",
        "Follow": "follow",
        "Following": "following",
        "Judgement": "verdict",
        "Source": "bench",
        "Verdict": "verdict",
        "intervene_on": "intervening",
        "judge": "verdict",
        "judgements": "verdict",
        "load_effects": "effects",
        "stored_following": "following",
        "stored_interventions": "stored",
    },
)
