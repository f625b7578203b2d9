"""Words of interventions stored in format 1, read as today's: one table, applied after the hashes were checked."""

from collections.abc import Mapping
from typing import Any

FORMER_FORMAT = 1
"""Read, never written or continued."""
STORED_WORDS: Mapping[str, Mapping[str, str]] = {
    "setting": {"toward": "target_side", "doses": "coefficients", "cells": "targets"},
    "kind": {"follow": "image-swap", "words": "instruction-swap"},
    "readout": {"chunk": "first-chunk", "shadow": "per-step"},
    "condition": {"plain": "clean", "exchanged": "image_swap", "noted": "recorded"},
    "condition of words": {"exchanged": "instruction_swap", "pictures": "image_swap"},
    "stream": {"memory": "kv"},
    "array": {
        "lateral": "displacement",
        "changed": "max_action_change",
        "ledger": "edit_log",
        "apart": "replay_error",
        "outcomes": "episode_outcomes",
    },
    "certificate": {"readable": "probe_accuracy"},
    "edit": {
        "still": "no_op_fires",
        "moved": "change",
        "largest": "largest_change",
        "largest_change": "max_action_change",
    },
    "supported": {"follow": "swap", "memory": "kv"},
}
"""By what is named: the word of format 1, and today's."""


def current(what: str, word: str) -> str:
    """Today's word. what: a key of `STORED_WORDS`."""
    return STORED_WORDS[what].get(word, word)


def current_settings(settings: Mapping[str, Any], newest: int) -> dict[str, Any]:
    """Settings of format 1 in today's words, as those of the format `newest`; others as they are."""
    if settings.get("format") != FORMER_FORMAT:
        return dict(settings)
    found = {current("setting", name): value for name, value in settings.items()}
    found |= {"format": newest, "kind": current("kind", str(settings["kind"]))}
    found["readout"] = current("readout", str(settings.get("readout", "chunk")))
    for name in ("sites", "targets"):
        if isinstance(found.get(name), list):
            found[name] = [_site(str(pattern)) for pattern in found[name]]
    return found


def current_condition(condition: str, stored_kind: str) -> str:
    """Today's name of a condition. stored_kind: the kind by its former name."""
    if stored_kind == "words" and condition in STORED_WORDS["condition of words"]:
        return current("condition of words", condition)
    return _site(current("condition", condition))


def current_arrays(arrays: Mapping[str, Any], stored_kind: str) -> dict[str, Any]:
    """The arrays of `episodes.npz` and the names of conditions in it."""
    found = {current("array", name): value for name, value in arrays.items()}
    found["conditions"] = [current_condition(str(name), stored_kind) for name in found["conditions"]]
    return found


def current_certificate(certificate: Mapping[str, Any], stored_kind: str) -> dict[str, Any]:
    """What a certificate says of conditions and edits; the rest as it is."""
    found = {current("certificate", name): value for name, value in certificate.items()}
    if "edits" in found:
        found["edits"] = {
            current_condition(name, stored_kind): {current("edit", own): value for own, value in edit.items()}
            for name, edit in found["edits"].items()
        }
    if "probe_accuracy" in found:
        read = found["probe_accuracy"].items()
        found["probe_accuracy"] = {current_condition(name, stored_kind): value for name, value in read}
    if "supported" in found:
        supported = dict(found["supported"])
        supported["readout"] = current("readout", str(supported.get("readout", "chunk")))
        supported["kinds"] = [current("supported", kind) for kind in supported.get("kinds", ())]
        found["supported"] = supported
    return found


def _site(name: str) -> str:
    """With today's name of the stream before the first dot."""
    stream, dot, rest = name.partition(".")
    return f"{current('stream', stream)}{dot}{rest}" if dot else name
