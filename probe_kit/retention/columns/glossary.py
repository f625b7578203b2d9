"""Terms of the tables that are no column; the meaning of a column is declared with it."""

TERMS = {
    "call": ("Which inference of an episode was probed, counted from 0: call 0 comes before anything has moved."),
    "probe": (
        "A logistic regression that is shown activations of one layer and must name the side of the correct "
        "picture, in episodes and questions it was not fitted on."
    ),
    "reach": (
        "The distance between the actions of a policy that go left and those that go right: the unit in which the "
        "image swap moves an action."
    ),
    "n/a": (
        "The backbone's signal is not shown: its best layer is not shown to exceed chance and every control that "
        "was run. So there may be nothing to retain."
    ),
    "B − A": (
        "Difference of a run and the first one, or that of --compare, on the same questions. They count as pairs, "
        "with a 95 % interval. Zero inside it: they may be equal."
    ),
    "against": ("Before a verdict: the same, away from the correct picture."),
    "random weights": ("The model is untrained. It shows the numbers of a model that knows nothing."),
}
"""Terms that are no column."""

VIEWER_WORDS = {
    "success": "The cube ends on the correct picture. Guessing reaches 50 %.",
    "Δ": "How far from 50 % guessing alone may lead. Success is shown beyond it.",
    "shown": "A stream's best site exceeds chance, family-wise, and every control that was run: its signal.",
    "not shown": "Neither shown nor absent: the items are too few to tell.",
    "absent": "For a linear probe of so many items: the best site can be at most as accurate as a stated limit, "
    "65 % by default, and so many items would have shown a site of that accuracy.",
    "retention": "Share of the backbone's accuracy above chance that is left where the action is made.",
    "used": "Swapping the two pictures turns the action: only an intervention shows it.",
    "log-odds": "How sure the probe is of the correct side in one episode; below zero it reads the other side.",
    "probe": TERMS["probe"],
    "call": TERMS["call"],
}
"""The words that the viewer explains."""
