"""What every number of the tables means: the help of every column, and further terms."""

from collections.abc import Mapping
from types import MappingProxyType

from probe_kit.retention.columns.columns import all_columns

TERMS = {
    "call": (
        "Which inference of an episode was probed, counted from 0: call 0 comes before anything has moved. "
        "A policy that reaches for the cube first may not need the answer yet."
    ),
    "probe": (
        "A logistic regression that is shown activations of one layer and must name the side of the correct "
        "picture, in episodes and questions it was not fitted on."
    ),
    "normalised score": ("Mean success rate on a scale where guessing is 0 and perfection 100."),
    "retention": (
        "(action − chance) / (backbone − chance): the share of what can be read in the backbone that can "
        "still be read where the action is made. Biased upwards when signals are weak: both are maxima."
    ),
    "n/a": (
        "The backbone's best layer does not beat chance and every control that was run, so there is nothing "
        "that could be retained."
    ),
    "A − B": (
        "Difference of two runs on the same questions: of both the same groups of questions are drawn, over "
        "and over, and the interval holds 95 % of what that gives. Zero inside it: they may be equal."
    ),
    "random weights": ("Nobody trained this model. It shows what knowing nothing looks like."),
}
"""Terms that are no column."""


def glossary() -> Mapping[str, str]:
    """Heading or term to meaning."""
    return MappingProxyType({column.heading: column.help for column in all_columns()} | TERMS)
