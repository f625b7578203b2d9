"""EO-1 through lerobot.

Its page is `docs/pi0.md`; its golden reference is `tests/golden/eo1`.
"""

from probe_kit.hooks.contract.declared import Interventions, backbone, expert
from probe_kit.hooks.contract.sites import QUANTITIES
from probe_kit.hooks.families.shared.kinds import MERGED, NO_HEAD, lerobot_family
from probe_kit.hooks.family_parts import Abilities, Checkpoints, Requirements

INTERVENTIONS = Interventions(
    edits={"backbone": QUANTITIES, "expert": QUANTITIES},
    unread=("backbone",),
    prompt_kv=True,
    instead={
        "attention": "its decoder's fast kernel returns no weights. Patch `kv` instead",
        "gradients": "lerobot's sampling writes every step's chunk into the same tensor. Patch exactly: `--kind "
        "interchange`, or `--kind joint`",
        "tiles": f"{MERGED}Exchange all of `image`",
    },
)
"""The interventions of one decoder that reads the prompt, then the noisy actions at every step.

The actions read the keys and values of the prompt.
"""

FAMILIES = (
    lerobot_family(
        "eo1",
        "EO-1 (Qwen2.5-VL 3B whose decoder denoises actions) through lerobot",
        None,
        "eo1.adapter:Eo1",
        embodiment="as the checkpoint's data set",
        notes=(
            "A checkpoint in lerobot's layout, with the configuration of its Qwen2.5-VL in config.json; the "
            "processor's files lie beside it or come from the repository that policy_preprocessor.json names"
        ),
        requirements=Requirements(needs_checkpoint=True),
        checkpoints=Checkpoints(
            parameters={"": 3_771_607_072},
            declared={
                "": (
                    backbone(37, 2048, 160, "state", camera="image"),
                    expert(37, 2048, 10, 8, ("action",)),
                )
            },
        ),
        abilities=Abilities(interventions=INTERVENTIONS, no_words=NO_HEAD),
    ),
)
