"""MolmoAct2 through lerobot.

Its page is `docs/pi0.md`; its golden reference is `tests/golden/molmoact2`.
"""

from dataclasses import replace

from probe_kit.hooks.contract.declared import backbone, expert
from probe_kit.hooks.contract.sites import QUANTITIES
from probe_kit.hooks.families.shared.kinds import FLOW, MERGED, NO_HEAD, lerobot_family
from probe_kit.hooks.family_parts import Abilities, Checkpoints

EXPERT = ("residual", "attention", "cross_attention", "mlp", "final_norm")
LAYERWISE = replace(
    FLOW,
    edits={"backbone": QUANTITIES, "expert": EXPERT},
    tiles=False,
    instead={
        "tiles": f"{MERGED}Its tower reads overlapping crops. Exchange all of `image`",
        "knockout": "no hook reaches the heads of its expert. Patch `kv` instead",
    },
)
"""The interventions of an expert whose block n reads the keys and values of block n of the backbone.

It reads nothing else of the backbone.
"""

FAMILIES = (
    lerobot_family(
        "molmoact2",
        "MolmoAct2 (Molmo2-ER, flow-matching expert on the keys and values of each layer) through lerobot",
        "allenai/MolmoAct2-LIBERO-LeRobot",
        "molmoact2.adapter:MolmoAct2",
        embodiment="LIBERO end-effector delta; other fine-tunes in lerobot's layout as --checkpoint",
        notes=(
            "A checkpoint names a second one, whose configuration and tokenizer are fetched, not its weights. 5.4 "
            "billion parameters, 11 GB in bfloat16; lerobot measured 12 GiB. Acts by its flow expert; discrete "
            "actions are refused. CUDA graphs are off"
        ),
        checkpoints=Checkpoints(
            hub=(("allenai/MolmoAct2-LIBERO", "tokenizer.json"),),
            parameters={"": 5_442_196_208},
            declared={
                "": (
                    backbone(37, 2560, 310, "state", camera="image"),
                    expert(37, 768, 10, 30, ("action",), quantities=EXPERT, sums=False),
                )
            },
        ),
        abilities=Abilities(interventions=LAYERWISE, no_words=NO_HEAD),
    ),
)
