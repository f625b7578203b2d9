"""Declarations that all families of one kind share, and the interventions that they support. Imports no torch."""

from dataclasses import replace
from typing import Any

from probe_kit.hooks.contract.interventions import Interventions
from probe_kit.hooks.contract.options import Option
from probe_kit.hooks.contract.sites import QUANTITIES
from probe_kit.hooks.family import Family

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

_FAMILIES = "probe_kit.hooks.families"
TOKENIZER_FOLDER = Option("tokenizer", str, "Folder of another tokenizer.json.", "the checkpoint's", is_path=True)


def lerobot_family(name: str, description: str, checkpoint: str | None, adapter: str, **fields: Any) -> Family:
    """A policy of lerobot's. adapter: `folder.adapter:Class`; the folder is named as lerobot names the policy.

    fields: others of `Family`.
    """
    kind, path = adapter.partition(".")[0], f"{_FAMILIES}.{adapter}"
    shared = {
        "outputs": f"{_FAMILIES}.shared.lerobot.outputs:lerobot_outputs",
        "config_types": (kind,),
        "words": f"{path}.check_words",
        "full_size": f"probe_kit.models.lerobot.{kind}:full_size_{kind}",
    }
    return Family(name, description, checkpoint, f"{path}.load", **{**shared, **fields})


def answering_family(name: str, description: str, checkpoint: str | None, loader: str, **fields: Any) -> Family:
    """A VLM that answers and does not act. loader: `folder.adapter:function`. fields: others of `Family`."""
    shared = {
        "embodiment": "none: answers, does not act",
        "outputs": f"{_FAMILIES}.shared.vlm.outputs:vlm_outputs",
        "acts": False,
        "reads": True,
    }
    return Family(name, description, checkpoint, f"{_FAMILIES}.{loader}", **{**shared, **fields})
