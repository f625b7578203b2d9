"""Xiaomi-Robotics-R0, native.

Its page is `docs/qwen-vla.md`; its golden reference is `tests/golden/xiaomi_r0`.
"""

from probe_kit.hooks.contract.card import SourceWeights
from probe_kit.hooks.contract.declared import ACT2ANSWER, Interventions, Option, ProtocolRow, backbone, expert
from probe_kit.hooks.contract.observation import OPENNESS
from probe_kit.hooks.contract.sites import QUANTITIES
from probe_kit.hooks.families.shared.kinds import MERGED, NO_HEAD, TOKENIZER_FOLDER
from probe_kit.hooks.family import Family
from probe_kit.hooks.family_parts import Abilities, Checkpoints

_EXPERT = ("residual", "attention", "middle", "mlp")
INTERVENTIONS = Interventions(
    edits={"backbone": QUANTITIES, "expert": _EXPERT},
    unread=("backbone",),
    prompt_kv=True,
    attention=True,
    instead={"tiles": f"{MERGED}Exchange all of `image`"},
)
"""The interventions of an expert that reads keys and values of the backbone's last blocks.

Those of the blocks before are unread.
"""

FAMILIES = (
    Family(
        "xiaomi-r0",
        "Xiaomi-Robotics-R0 (Qwen3-VL 4B + flow transformer on its keys and values), native",
        "XiaomiRobotics/Xiaomi-Robotics-0-SimplerEnv-WidowX",
        "probe_kit.hooks.families.xiaomi.adapter:load_xiaomi",
        embodiment="as the robot of -M robot; bridge: WidowX end-effector delta at 5 Hz",
        notes="Apache-2.0; 9.4 GB in bfloat16; the expert's layers renormalise their stream inside",
        options=(
            Option("robot", str, "Robot whose statistics, picture and state are used.", "the only one"),
            Option("steps", int, "Euler steps of the flow.", "5"),
            TOKENIZER_FOLDER,
            Option("openness", str, "release: as Act2Answer's evaluation has it.", "measured", OPENNESS),
        ),
        protocols={
            ACT2ANSWER: ProtocolRow(
                "XiaomiRobotics/Xiaomi-Robotics-0-SimplerEnv-WidowX",
                execute=4,
                rotation="axis-angle",
                dtype="bfloat16",
                options={"steps": 5, "openness": "release"},
                of_checkpoint={"robot": "bridge_delta"},
                unmatched=("noise comes from the episode's seed, not from a hash of the inputs",),
            )
        },
        abilities=Abilities(
            outputs="probe_kit.hooks.families.xiaomi.adapter:xiaomi_outputs",
            units="probe_kit.hooks.families.xiaomi.adapter:xiaomi_units",
            interventions=INTERVENTIONS,
            no_words=NO_HEAD,
        ),
        checkpoints=Checkpoints(
            source="qwen3-vl",
            source_weights=SourceWeights("Qwen/Qwen3-VL-4B-Instruct", parameters=4_437_815_808),
            of_default={"robot": "bridge_delta"},
            declared={
                "": (
                    backbone(37, 2560, 125, sums=False),
                    expert(17, 1024, 5, 32, ("special", "state", "action"), quantities=_EXPERT, sums=False),
                )
            },
            full_size="probe_kit.hooks.families.xiaomi.network:full_size_xiaomi",
            parameters={"": 4_716_274_176},
        ),
    ),
)
