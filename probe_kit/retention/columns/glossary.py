"""What every number of the report means, in words that need no paper beside them."""

from types import MappingProxyType

GLOSSARY = MappingProxyType(
    {
        "SR": (
            "Success rate: share of episodes in which the cube ended on the correct picture. In brackets the 95 "
            "% interval, whole groups of questions resampled. Two pictures: guessing gives 50 %."
        ),
        "Δ": (
            "How far from 50 % guessing alone may lead, which decides the reading. It counts questions, and those "
            "that share a picture and are answered alike as fewer."
        ),
        "paper's Δ": (
            "The same if every episode were a question of its own, as the paper has it. It decides nothing here."
        ),
        "call": (
            "Which inference of an episode was probed, counted from 0: call 0 comes before anything has moved. A "
            "policy that reaches for the cube first may not need the answer yet."
        ),
        "first iteration": (
            "Best layer at the first iteration, which has seen nothing of the action. Late iterations hold the "
            "decision itself, as a noisy action or as the tokens before."
        ),
        "follows / against": (
            "With the two pictures exchanged, and nothing else: share of episodes whose action then turns from "
            "the correct picture's side to the other one, and share in which it does the reverse."
        ),
        "used": (
            "Whether the action follows what can be read in the backbone. Encoded, unused: it can be read, and "
            "the action does not change with it, while another category's does."
        ),
        "wrong": "Share of episodes that ended on the other picture.",
        "outside": "Share of episodes that ended on neither picture.",
        "never moved": (
            "Share of episodes, part of outside, in which the cube was never carried away: a failed grasp "
            "rather than a wrong answer."
        ),
        "original": "Success rate in the layout as drawn.",
        "swapped": "Success rate with the two pictures exchanged.",
        "left": "Success rate where the correct picture lay on the left.",
        "right": "Success rate where it lay on the right. Left and right far apart: the policy goes to a side.",
        "goes left": (
            "Among episodes that reached a picture, the share that ended on the left one. 50 %: no habit."
        ),
        "flagged": (
            "Share of the policy's steps in which it put out something that is no action, such as text. Magma "
            "then holds still; OpenVLA takes the nearest action, as its authors do."
        ),
        "right twice": (
            "Questions answered correctly in both layouts, of those that ran in both. A habit of going to one "
            "side cannot produce these."
        ),
        "p (twice)": "Probability that luck alone gives so many questions right twice rather than wrong twice.",
        "p (difference)": (
            "Of a difference between two runs: probability that two equally good ones differ so much on these "
            "questions, whole groups turned together; in brackets corrected by Holm for all categories and pairs."
        ),
        "reading": (
            "Knowledge: further above 50 % than guessing leads with this many questions. Not reliable: not so "
            "far. Failure: as far below; the policy misses both pictures or prefers the wrong one."
        ),
        "normalised score": "Mean success rate on a scale where guessing is 0 and perfection 100.",
        "n": "Episodes, and in brackets questions; each question is asked in two layouts.",
        "probe": (
            "A logistic regression that is shown activations of one layer and must name the side of the correct "
            "picture, in episodes and questions it was not fitted on."
        ),
        "backbone": "Best held-out accuracy of a probe in the vision-language backbone, over its layers.",
        "action": (
            "Best held-out accuracy of a probe where the action is made (the action expert, or the positions that "
            "choose action tokens), over layers and iterations."
        ),
        "chance": "Accuracy of always naming the more frequent side.",
        "layer": (
            "Where the best probe reads: 0 enters the first block, the last one leaves the last block. The first "
            "of several that are equally good; after +: how many others are. After @: the iteration, a "
            "flow-matching step or an action token."
        ),
        "p": (
            "Probability that the best layer of a stream looks this good when the answers are relabelled at "
            "random. It allows for having looked at all layers (family-wise)."
        ),
        "beats": (
            "What the best layer is better than, family-wise and paired by question: chance; binding, an "
            "untrained conjunction of pictures and words; untrained, the same network with random weights. Only "
            "what beats all that was tried is knowledge; against chance alone a random network can look knowing."
        ),
        "retention": (
            "(action − chance) / (backbone − chance): the share of what can be read in the backbone that can "
            "still be read where the action is made. Biased upwards when signals are weak: both are maxima."
        ),
        "bounded": (
            "Retention between its bounds: four fifths the debiased estimate, which is too low where the best "
            "layer is missed, and one fifth the peaks, which are too high. The number to quote for one category."
        ),
        "area": (
            "The same ratio with the mean over all layers (and iterations) in place of the best: how much of the "
            "stack carries the answer. Nothing is chosen, so nothing is biased; the number to average."
        ),
        "debiased": (
            "The same with the layers chosen on other episodes than they are scored on. In brackets the 95 % "
            "interval; “unbounded” means that with so few groups of questions the backbone's score above chance "
            "may be a quarter of what it seems, or nothing: too little to divide by."
        ),
        "gap": "Backbone accuracy minus success rate, in points: what can be read but is not acted on.",
        "groups": "Independent groups of questions; questions that share a picture count once.",
        "n/a": (
            "The backbone's best layer does not beat chance and every control that was run, so there is nothing "
            "that could be retained."
        ),
        "A − B": (
            "Difference of two runs on the same questions: of both the same groups of questions are drawn, over "
            "and over, and the interval holds 95 % of what that gives. Zero inside it: they may be equal."
        ),
        "selectivity": "Accuracy above that of the same probe on random labels.",
        "position, instruction, pixels": (
            "The same probe on the layout, the words, or the two pictures alone. Red: the suite gives the "
            "answer away without a model."
        ),
        "untrained": (
            "The same probes on another run of the same episodes, usually with untrained weights, subtracted."
        ),
        "random weights": "Nobody trained this model. It shows what knowing nothing looks like.",
    }
)
"""Term to meaning; the headings of the tables show these too."""
