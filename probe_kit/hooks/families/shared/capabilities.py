"""Interventions that families of one kind support. Imports no torch."""

from dataclasses import replace

from probe_kit.hooks.contract.interventions import Interventions
from probe_kit.hooks.contract.sites import QUANTITIES

FLOW = Interventions(
    edits={"backbone": QUANTITIES, "expert": QUANTITIES},
    unread=("backbone",),
    prompt_kv=True,
    attention=True,
    tiles=True,
    gradients=True,
)
"""An action expert reads the backbone's keys and values, at every flow-matching step, and nothing else of it."""

TOKENS = Interventions(
    edits={"backbone": QUANTITIES, "action": QUANTITIES},
    unread=("backbone",),
    prompt_kv=True,
    attention=True,
    first_affected_token=1,
    tiles=True,
    readout="per-step",
)
"""One decoder reads the prompt and puts out tokens; the prompt's own pass chooses the first of them."""

MERGED = "it merges patches on their way to the backbone, and does not report which token they become. "
"""Why a family does not say what tile a token is of."""
MAPS = replace(
    TOKENS,
    tiles=False,
    instead={"tiles": f"{MERGED}Its tower makes maps of several crops. Exchange all of `image`"},
)
"""The same, where a picture becomes maps of several crops."""
