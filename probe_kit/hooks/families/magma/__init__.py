"""Magma, native.

Its page is `docs/token-policies.md`; its golden reference is `tests/golden/magma`.
"""

from probe_kit.hooks.contract.declared import ACT2ANSWER, OWN_SEEDS, Option, ProtocolRow, backbone, chosen_tokens
from probe_kit.hooks.families.shared.kinds import MAPS
from probe_kit.hooks.family import Family
from probe_kit.hooks.family_parts import Abilities, Checkpoints, Requirements

FAMILIES = (
    Family(
        "magma",
        "Magma (ConvNeXt-XXLarge, Llama 3 8B, actions as tokens, answers in text), native",
        "microsoft/Magma-8B",
        "probe_kit.hooks.families.magma.adapter:load_magma",
        embodiment="as the data set of -M unnorm_key; bridge_orig: WidowX end-effector delta at 5 Hz",
        notes="MIT, Llama 3 licence; extra magma; about 18 GB in bfloat16",
        options=(
            Option("unnorm_key", str, "Data set whose units the actions get.", "the only one"),
            Option(
                "statistics",
                str,
                "File with action statistics, instead of the checkpoint's.",
                "none",
                is_path=True,
            ),
            Option("shrink", int, "Side to which pictures are shrunk first; 0: whole, at any resolution.", "256"),
            Option(
                "prompt",
                str,
                "Order of turns; act2answer: the user's first.",
                "magma",
                choices=("magma", "act2answer"),
            ),
            Option("temperature", float, "0: the likeliest token; 0.7: drawn as the release does.", "0"),
            Option("tokenizer", str, "Folder of another tokenizer.", "the checkpoint's", is_path=True),
            Option(
                "layer_scale",
                str,
                "gamma: refuse files that name the vision tower's layer scales weight.",
                "either name",
                choices=("gamma", "weight"),
            ),
        ),
        protocols={
            ACT2ANSWER: ProtocolRow(
                "microsoft/Magma-8B",
                execute=1,
                dtype="bfloat16",
                options={"unnorm_key": "bridge_orig", "prompt": "act2answer", "temperature": 0.7, "shrink": 256},
                unmatched=(
                    OWN_SEEDS,
                    "an answer that is no action stops the hand; there row 0's tokens are taken",
                ),
            )
        },
        requirements=Requirements(packages=(("timm", "magma"),)),
        abilities=Abilities(
            outputs="probe_kit.hooks.families.magma.adapter:magma_outputs",
            words="probe_kit.hooks.families.magma.adapter:check_magma_words",
            units="probe_kit.hooks.families.magma.adapter:magma_units",
            reads=True,
            interventions=MAPS,
        ),
        checkpoints=Checkpoints(
            of_default={"unnorm_key": "bridge_orig"},
            declared={"": (backbone(33, 4096, 320, "separator"), chosen_tokens("action", 33, 4096, 7))},
            full_size="probe_kit.hooks.families.magma.network:full_size_magma",
            parameters={"": 8_903_549_824},
            unstored=(
                "vision_tower.clip_vision_model.head.",
                "vision_tower.clip_vision_model.trunk.head.",
            ),
        ),
    ),
)
