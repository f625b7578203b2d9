"""MolmoAct2 through lerobot."""

from dataclasses import replace

from probe_kit.hooks.contract.sites import QUANTITIES
from probe_kit.hooks.families.shared.capabilities import FLOW, MERGED
from probe_kit.hooks.family import Family

EXPERT = ("residual", "attention", "cross_attention", "mlp", "final_norm")
LAYERWISE = replace(
    FLOW,
    edits={"backbone": QUANTITIES, "expert": EXPERT},
    attention=False,
    tiles=False,
    gradients=False,
    instead={"tiles": f"{MERGED}Its tower reads overlapping crops. Exchange all of `image`"},
)
"""Block n of the expert reads the keys and values of block n of the backbone, and nothing else of it."""

FAMILIES = (
    Family(
        "molmoact2",
        "MolmoAct2 (Molmo2-ER, flow-matching expert on the keys and values of each layer) through lerobot",
        None,
        "probe_kit.hooks.families.molmoact2.adapter:load_molmoact2",
        streams="backbone and expert have the layers of the checkpoint's configuration, expert x flow steps",
        embodiment="as fine-tuned",
        needs_checkpoint=True,
        notes=(
            "Pass a checkpoint in lerobot's layout, such as allenai/MolmoAct2-LIBERO-LeRobot. It names a second, "
            "whose configuration and tokenizer are fetched, not its weights. lerobot measured 12 GiB in bfloat16. "
            "Acts by its flow expert; discrete actions are refused. CUDA graphs are off"
        ),
        verifier="probe_kit.hooks.families.molmoact2.verify:verify_molmoact2",
        config_types=("molmoact2",),
        words="probe_kit.hooks.families.molmoact2.adapter:check_molmoact2_words",
        full_size="probe_kit.models.lerobot.molmoact2:full_size_molmoact2",
        interventions=LAYERWISE,
    ),
)
