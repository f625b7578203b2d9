"""Closed vocabularies of the retention commands. Importing them loads no statistics."""

from typing import Literal

AnswerScore = Literal["text", "logits", "order-balanced"]
"""How the answers of a VLM are read: from its text, from the logits of the options, or from logits averaged over
both orders of the options."""
Section = Literal["success", "rules", "answers", "probes", "retention", "controls", "interventions"]
"""Groups of tables that `retention --details` shows."""
Family = Literal["label", "table"]
"""Tests of labels that are corrected together: a stream's sites, or those of every label of the table (Holm)."""
TableFormat = str
"""`table`, `json`, `csv` or a format of `probe_kit._tables.formats`."""
