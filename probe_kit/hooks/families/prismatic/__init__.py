"""Prismatic vision-language models, native.

Its page is `docs/answer-models.md`. Its golden references are
`tests/golden/prismatic` and `tests/golden/vlm/prismatic`.
"""

from probe_kit.hooks.checkpoints.checkpoint import PATTERNS, RUN_WEIGHTS
from probe_kit.hooks.contract.declared import Option, answering
from probe_kit.hooks.families.shared.kinds import TOKENIZER_FOLDER, answering_family
from probe_kit.hooks.family_parts import Abilities, Checkpoints, Requirements

BITS = Option("bits", int, "Quantised, not exact (extra quantized, GPU).", "none", choices=(4, 8))

FAMILIES = (
    answering_family(
        "prismatic",
        "Prismatic vision-language models, OpenVLA's source (one or two towers; Llama 2, Vicuna, Mistral, Phi-2)",
        "TRI-ML/prismatic-vlms/prism-dinosiglip-224px+7b",
        "prismatic.adapter:load_prismatic",
        notes=(
            "MIT, Llama 2 licence; extra openvla; one .pt file, towers of timm, tokenizer of openvla/openvla-7b; "
            "also folders in the layout of PrismaticForConditionalGeneration"
        ),
        options=(TOKENIZER_FOLDER, BITS, Option("steps", int, "Greedy tokens per inference.", "1")),
        requirements=Requirements(packages=(("timm", "openvla"),)),
        abilities=Abilities(outputs="probe_kit.hooks.families.prismatic.outputs:prismatic_outputs"),
        checkpoints=Checkpoints(
            config_types=("prismatic", "openvla"),
            files=(*PATTERNS, RUN_WEIGHTS),
            hub=(
                ("timm/vit_large_patch14_reg4_dinov2.lvd142m", "model.safetensors"),
                ("timm/vit_so400m_patch14_siglip_224.webli", "model.safetensors"),
                ("openvla/openvla-7b", "tokenizer.json"),
            ),
            declared={"": answering(33, 4096, 290)},
            full_size="probe_kit.hooks.families.prismatic.network:full_size_prismatic",
            parameters={"": 7_541_237_184},
        ),
    ),
)
