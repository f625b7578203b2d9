"""The seeds of random accidents. Each night draws others, so that a night takes minutes and no two are alike.

`PROBE_KIT_NIGHT=17 pytest -m slow FILE` draws what the seventeenth night drew; names of tests show the seeds.
"""

import os

NIGHT = int(os.environ.get("PROBE_KIT_NIGHT", "0"))
BLOCK = 100
"""Number of seeds in a test."""


def seeds_of_tonight(draws: int) -> list[range]:
    """Return tonight's seeds in blocks; `draws` is their number."""
    first = NIGHT * draws
    return [range(start, start + BLOCK) for start in range(first, first + draws, BLOCK)]
