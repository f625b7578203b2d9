"""Ovis2.5, native.

Its page is `docs/answer-models.md`; its golden reference is `tests/golden/vlm/ovis2_5`.
"""

from probe_kit.hooks.contract.declared import answering
from probe_kit.hooks.families.shared.kinds import TOKENIZER_FOLDER, answering_family
from probe_kit.hooks.family_parts import Checkpoints

FAMILIES = (
    answering_family(
        "ovis2.5",
        "Ovis2.5 (SigLIP 2 at any resolution, visual words, Qwen3 decoder), native",
        "AIDC-AI/Ovis2.5-9B",
        "ovis2_5.adapter:Ovis25.load",
        notes="asked without its thought; 18 GB in bfloat16",
        options=(TOKENIZER_FOLDER,),
        checkpoints=Checkpoints(
            config_types=("ovis2_5",),
            declared={"": answering(37, 4096, 240)},
            full_size="probe_kit.hooks.families.ovis2_5.network:full_size_ovis2_5",
            parameters={"": 9_174_807_784},
        ),
    ),
)
