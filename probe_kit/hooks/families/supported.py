"""What families of one kind support of the interventions. Imports no torch."""

from probe_kit.hooks.interventions import Interventions
from probe_kit.hooks.sites import QUANTITIES

FLOW = Interventions(
    edits={"backbone": QUANTITIES, "expert": QUANTITIES},
    unread=("backbone",),
    memory=True,
    attention=True,
)
"""An action expert reads the backbone's keys and values, at every flow-matching step, and nothing else of it."""

TOKENS = Interventions(
    edits={"backbone": QUANTITIES, "action": QUANTITIES},
    unread=("backbone",),
    memory=True,
    attention=True,
    heard_from=1,
    readout="shadow",
)
"""One decoder reads the prompt and puts out tokens; the prompt's own pass chooses the first of them."""
