"""OpenVLA, native.

Its page is `docs/token-policies.md`; its golden reference is `tests/golden/openvla`.
"""

from probe_kit.hooks.contract.declared import ACT2ANSWER, OWN_SEEDS, Option, ProtocolRow, backbone, chosen_tokens
from probe_kit.hooks.families.prismatic import BITS
from probe_kit.hooks.families.shared.kinds import TOKENIZER_FOLDER, TOKENS
from probe_kit.hooks.family import Family
from probe_kit.hooks.family_parts import Abilities, Checkpoints, Requirements

BRIDGE = "bridge_orig"
"""The data set of the WidowX arm that Act2Answer imitates."""


def _row(variant: str, checkpoint: str, unnorm_key: str, *alternatives: ProtocolRow) -> ProtocolRow:
    """Return one of the three rows that the evaluation compares; they differ in checkpoint and units only."""
    return ProtocolRow(
        checkpoint,
        execute=1,
        dtype="bfloat16",
        options={"temperature": 0.6, "top_k": "checkpoint", "resize": "tensor", "centre_crop": False},
        of_checkpoint={"unnorm_key": unnorm_key},
        unmatched=(OWN_SEEDS, "another filter than the checkpoint's own would not be noticed"),
        variant=variant,
        alternatives=alternatives,
    )


FAMILIES = (
    Family(
        "openvla",
        "OpenVLA (DINOv2 + SigLIP, Llama 2 7B, actions as tokens), native; fine-tunes and LoRA as --checkpoint",
        "openvla/openvla-7b",
        "probe_kit.hooks.families.openvla.adapter:load_openvla",
        embodiment="as the data set of -M unnorm_key; bridge_orig: WidowX end-effector delta at 5 Hz",
        notes="MIT, Llama 2 licence; extra openvla; about 16 GB in bfloat16",
        options=(
            Option("unnorm_key", str, "Data set whose units the actions get.", "the only one"),
            Option(
                "prompt",
                str,
                "openvla, openvla-v01 or a template with {instruction}.",
                "the checkpoint's generation's",
            ),
            Option("centre_crop", bool, "Show 0.9 of the area: fine-tunes with augmentation.", "false"),
            TOKENIZER_FOLDER,
            BITS,
            Option("temperature", float, "0: the likeliest; above: drawn among tokens of actions.", "0"),
            Option(
                "top_k",
                str,
                "Draw among so many likeliest; checkpoint: its generation_config.json's, else 50.",
                "all",
            ),
            Option(
                "resize",
                str,
                "tensor: in bfloat16, as Act2Answer's evaluation.",
                "pil",
                choices=("pil", "tensor"),
            ),
        ),
        protocols={
            ACT2ANSWER: _row(
                "SFT",
                "gen-robot/openvla-7b-rlvla-sft_16k",
                "sft",
                _row("RL", "gen-robot/openvla-7b-rlvla-rl", BRIDGE),
                _row("base", "openvla/openvla-7b", BRIDGE),
            )
        },
        requirements=Requirements(packages=(("timm", "openvla"),)),
        abilities=Abilities(
            outputs="probe_kit.hooks.families.openvla.adapter:openvla_outputs",
            words="probe_kit.hooks.families.openvla.adapter:check_openvla_words",
            units="probe_kit.hooks.families.openvla.adapter:openvla_units",
            interventions=TOKENS,
        ),
        checkpoints=Checkpoints(
            config_types=("openvla", "prismatic"),
            source="prismatic",
            of_default={"unnorm_key": BRIDGE},
            declared={"": (backbone(33, 4096, 275), chosen_tokens("action", 33, 4096, 7))},
            full_size="probe_kit.hooks.families.prismatic.network:full_size_openvla",
            parameters={"": 7_541_237_184},
        ),
    ),
)
