"""The relation of a policy to a VLM: whether its network grew from the weights that were asked."""

from collections.abc import Mapping
from typing import Any, Literal

from probe_kit.runs.reader import RunReader

Relation = Literal["yes", "no", "unknown"]


def grew_from(policy: RunReader, vlm: RunReader) -> Relation:
    """Compares hash, hub id and number of parameters on both cards; `unknown` where they are too little.

    A family's name says which network it is and not which weights: another name is another source, the same name
    is no evidence. A card names its commit behind an @; the source of a family is known by repository only.
    """
    grown, vlm_card = card_of(policy), card_of(vlm)
    if grown.get("random_weights") or vlm_card.get("random_weights"):
        return "no"
    source = grown.get("source_weights") or {}
    if source.get("sha256"):
        return "yes" if source["sha256"] == vlm_card.get("weights_sha256") else "no"
    if source.get("checkpoint") and source["checkpoint"] == str(vlm_card.get("checkpoint")).partition("@")[0]:
        return "yes"
    sizes = source.get("parameters"), vlm_card.get("parameters")
    told_apart_by = sizes if None not in sizes else (grown.get("source"), vlm_card.get("family"))
    return "no" if None not in told_apart_by and len(set(told_apart_by)) == 2 else "unknown"


def card_of(run: RunReader) -> Mapping[str, Any]:
    """Return what was really loaded; empty where a run has no certificate."""
    certificate: Mapping[str, Any] = run.certificate
    card: Mapping[str, Any] = certificate.get("policy") or {}
    return card
