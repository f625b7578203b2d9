"""Declarations that all families of one kind share. Imports no torch."""

from typing import Any

from probe_kit.hooks.contract.options import Option
from probe_kit.hooks.family import Family

_FAMILIES = "probe_kit.hooks.families"
TOKENIZER_FILE = Option("tokenizer", str, "Folder of another tokenizer.json.", "the checkpoint's", is_path=True)


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
