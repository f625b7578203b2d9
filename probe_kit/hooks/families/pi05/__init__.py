"""pi0.5 through lerobot."""

from probe_kit.hooks.contract.card import SourceWeights
from probe_kit.hooks.contract.declared import backbone, expert
from probe_kit.hooks.families.shared.kinds import FLOW, lerobot_family
from probe_kit.hooks.families.shared.lerobot.evaluation import EVALUATION_OPTIONS

FAMILIES = (
    lerobot_family(
        "pi05",
        "pi0.5 (PaliGemma 3B + 300M flow-matching expert with adaptive norms) through lerobot",
        "lerobot/pi05_base",
        "pi05.adapter:Pi05",
        embodiment="as fine-tuned; the base model acts in 32 unnamed dimensions",
        hub=(("google/paligemma-3b-pt-224", "tokenizer.json"),),
        notes=(
            "Gemma licence; tokenizer google/paligemma-3b-pt-224 is gated. The base can be captured without "
            "acting (--no-act); to act it needs a fine-tune for end-effector deltas. The prompt holds the state "
            "as digits"
        ),
        source="paligemma",
        source_weights=SourceWeights("google/paligemma-3b-pt-224", parameters=2_923_466_480),
        declared={
            "": (
                backbone(19, 2048, 968, "state", camera="base_0_rgb"),
                expert(19, 1024, 10, 50, ("action",)),
            )
        },
        parameters={"": 4_143_404_816},
        not_acting=("lerobot/pi05_base",),
        options=EVALUATION_OPTIONS,
        interventions=FLOW,
    ),
)
