"""The released checkpoints that grew from another one of their family, as far as their pages say."""

from collections.abc import Mapping
from types import MappingProxyType

GREW_FROM: Mapping[str, str] = MappingProxyType(
    {
        "gen-robot/openvla-7b-rlvla-sft_16k": "openvla/openvla-7b",
        "gen-robot/openvla-7b-rlvla-rl": "openvla/openvla-7b",
        "openvla/openvla-7b-finetuned-libero-spatial": "openvla/openvla-7b",
        "openvla/openvla-7b-finetuned-libero-object": "openvla/openvla-7b",
        "openvla/openvla-7b-finetuned-libero-goal": "openvla/openvla-7b",
        "openvla/openvla-7b-finetuned-libero-10": "openvla/openvla-7b",
    }
)
"""Hub id of the checkpoint that the training of another one began with, by the id of that one."""


def first_checkpoint(checkpoint: str) -> str:
    """Return the released checkpoint that one grew from, or itself; without its revision.

    Args:
        checkpoint: Hub id, OWNER/NAME[@REVISION], or a folder.
    """
    earlier = checkpoint.partition("@")[0]
    while earlier in GREW_FROM:
        earlier = GREW_FROM[earlier]
    return earlier
