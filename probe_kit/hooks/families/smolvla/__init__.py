"""SmolVLA through lerobot.

Its page is `docs/pi0.md`; its golden reference is `tests/golden/smolvla`.
"""

from probe_kit.hooks.contract.declared import backbone, expert
from probe_kit.hooks.families.shared.kinds import FLOW, NO_HEAD, lerobot_family
from probe_kit.hooks.family_parts import Abilities, Checkpoints, Requirements

FAMILIES = (
    lerobot_family(
        "smolvla",
        "SmolVLA (SmolVLM2 500M, 16 layers, + flow-matching expert) through lerobot",
        "lerobot/smolvla_base",
        "smolvla.adapter:SmolVLA",
        embodiment="as fine-tuned; the base model acts in SO-100 joint positions",
        notes=(
            "Apache-2.0; configuration and tokenizer of HuggingFaceTB/SmolVLM2-500M-Video-Instruct. The base can "
            "be captured without acting (--no-act); to act it needs a fine-tune for end-effector deltas"
        ),
        checkpoints=Checkpoints(
            hub=(("HuggingFaceTB/SmolVLM2-500M-Video-Instruct", "tokenizer.json"),),
            declared={
                "": (backbone(17, 960, 113, "state", camera="top"), expert(17, 720, 10, 50, ("action",))),
            },
            parameters={"": 450_046_176},
            not_acting=("lerobot/smolvla_base",),
        ),
        requirements=Requirements(always_float32=True),
        abilities=Abilities(interventions=FLOW, no_words=NO_HEAD),
    ),
)
