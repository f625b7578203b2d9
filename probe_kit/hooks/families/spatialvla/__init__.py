"""SpatialVLA, native.

Its page is `docs/token-policies.md`; its golden reference is `tests/golden/spatialvla`.
"""

from probe_kit.hooks.contract.declared import ACT2ANSWER, Option, ProtocolRow, backbone, chosen_tokens
from probe_kit.hooks.families.shared.kinds import TOKENIZER_FOLDER, TOKENS
from probe_kit.hooks.family import Family
from probe_kit.hooks.family_parts import Abilities, Checkpoints

FAMILIES = (
    Family(
        "spatialvla",
        "SpatialVLA (SigLIP + ZoeDepth, Gemma 2 2B, three action tokens per step), native; sees depth",
        "IPEC-COMMUNITY/spatialvla-4b-224-pt",
        "probe_kit.hooks.families.spatialvla.adapter:load_spatialvla",
        embodiment="as the data set of -M unnorm_key; bridge_orig/1.0.0: WidowX end-effector delta at 5 Hz",
        notes="MIT, Gemma licence; weights 8.1 GB in bfloat16; also …-mix-224-pt, …-sft-bridge, …-sft-fractal",
        options=(
            Option("unnorm_key", str, "Data set whose units the actions get.", "the only one"),
            Option("prompt", str, "bare, question or a template with {instruction}.", "bare"),
            Option("lowercase", bool, "Instruction in lower case, as in training.", "true"),
            Option("camera", str, "scene, or a data set of the checkpoint whose camera is taken for it.", "scene"),
            Option(
                "iterations", str, "Captured tokens: of a step (3) or of the chunk.", "step", ("step", "chunk")
            ),
            Option("constrained", bool, "Decode every token within its slot; not the original's way.", "false"),
            Option("ensemble", bool, "Average the plans of overlapping chunks, the newest most.", "false"),
            TOKENIZER_FOLDER,
        ),
        protocols={
            ACT2ANSWER: ProtocolRow(
                "IPEC-COMMUNITY/spatialvla-4b-224-pt",
                execute=1,
                dtype="bfloat16",
                options={"prompt": "bare", "lowercase": False, "ensemble": False},
                of_checkpoint={"unnorm_key": "bridge_orig/1.0.0"},
                unmatched=("pictures are resized from bytes, not from floats of 0 to 255",),
            )
        },
        abilities=Abilities(
            outputs="probe_kit.hooks.families.spatialvla.outputs:spatialvla_outputs",
            words="probe_kit.hooks.families.spatialvla.adapter:check_spatialvla_words",
            units="probe_kit.hooks.families.spatialvla.adapter:spatialvla_units",
            interventions=TOKENS,
            no_words="a feed-forward block of Gemma 2 ends in a norm, so that a unit adds no vector of its own",
        ),
        checkpoints=Checkpoints(
            of_default={"unnorm_key": "bridge_orig/1.0.0"},
            declared={"": (backbone(27, 2304, 269), chosen_tokens("action", 27, 2304, 3))},
            full_size="probe_kit.hooks.families.spatialvla.network:full_size_spatialvla",
            parameters={"": 4_027_854_731},
        ),
    ),
)
