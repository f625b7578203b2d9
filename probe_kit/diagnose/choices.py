"""Defaults of a diagnosis, and how many groups it draws; without imports."""

FRAMES = 24
"""With so many, words that decide were seen to in nine of ten draws or more; see `docs/notes/causal.md`."""
LEAST_GROUPS = 6
"""Fewer groups cannot show at p < 0.05 that anything matters, by sign flips of whole groups: 2⁻⁵ is 0.03."""


def count_groups(frames: int) -> int:
    """Return of how many groups of the scene so many frames are drawn: two frames of each.

    The two items of a group ask for one side each, before the same pictures. A policy that goes to one side where
    it does not understand is moved by other words in one of both, whichever side that is. The mean of both varies
    half as much between groups as one frame does.
    """
    return max(LEAST_GROUPS, -(-frames // 2))
