"""pi0-FAST through lerobot.

Its page is `docs/pi0.md`; its golden reference is `tests/golden/pi0_fast`.
"""

from dataclasses import replace

from probe_kit.hooks.contract.card import SourceWeights
from probe_kit.hooks.contract.declared import Option, backbone, chosen_tokens
from probe_kit.hooks.families.shared.kinds import TOKENS, lerobot_family
from probe_kit.hooks.family_parts import Abilities, Checkpoints

CAPTURED = 10
"""Action tokens whose positions are sites: "Action: ", and the lowest frequency of about seven dimensions."""
FAST = replace(TOKENS, readout="first-chunk")
"""The interventions of one decoder that puts out the tokens of a whole chunk."""

FAMILIES = (
    lerobot_family(
        "pi0-fast",
        "pi0-FAST (PaliGemma 3B, actions as compressed tokens) through lerobot",
        "lerobot/pi0fast-base",
        "pi0_fast.adapter:Pi0Fast",
        embodiment="as fine-tuned; the base model acts in 32 unnamed dimensions",
        notes=(
            "Gemma licence; tokenizer google/paligemma-3b-pt-224 is gated. The FAST tokenizer is read as data, "
            "without its remote code. Head and embedding are two: 3.4 billion parameters, 14 GB in float32. The "
            "base can be captured without acting (--no-act). A chunk is a variable number of tokens"
        ),
        options=(
            Option("captured_tokens", int, "Action tokens whose positions are sites.", str(CAPTURED)),
            Option("lowercase", bool, "Instruction in lower case, as openpi has it.", "false, as lerobot"),
            Option(
                "temperature",
                float,
                "0: the likeliest token; above: drawn by each row's seed.",
                "the checkpoint's",
            ),
        ),
        checkpoints=Checkpoints(
            hub=(
                ("google/paligemma-3b-pt-224", "tokenizer.json"),
                ("lerobot/fast-action-tokenizer", "processor_config.json"),
            ),
            source="paligemma",
            source_weights=SourceWeights("google/paligemma-3b-pt-224", parameters=2_923_466_480),
            declared={
                "": (
                    backbone(19, 2048, 968, "state", camera="base_0_rgb"),
                    chosen_tokens("action", 19, 2048, CAPTURED),
                )
            },
            parameters={"": 3_449_982_704},
            not_acting=("lerobot/pi0fast-base",),
        ),
        abilities=Abilities(interventions=FAST),
    ),
)
