"""Closed vocabularies of the retention commands. Importing them loads no statistics."""

from typing import Literal

AnswerScore = Literal["text", "logits", "order-balanced"]
"""The reading of a VLM's answers.

They are read from its text, from the logits of the options, or from logits averaged over both orders of the
options.
"""
Section = Literal["success", "rules", "answers", "probes", "retention", "controls", "interventions"]
"""Groups of tables that `retention --details` shows."""
Family = Literal["label", "table"]
"""Tests of labels that are corrected together: a stream's sites, or those of every label of the table (Holm)."""
Iterations = Literal["all", "best", "last"] | int
"""The iterations of the expert, or action tokens, that take part: all, the last one, or one by number.

Where one number is made of all of them it is the best one's, so that `best` is another word for `all`. A layer
curve draws a line for each of `all`, and one line for the `best` of every layer.
"""
ComparisonKind = Literal["runs", "groups", "vlm-vla", "stages", "steps"]
"""What `probe-kit compare` compares: runs, groups of models, VLMs with policies, a VLM and a policy question by
question, or checkpoints of one training."""
