"""InternVL, on transformers' own network.

Its page is `docs/answer-models.md`; its golden reference is `tests/golden/vlm/internvl`.
"""

from probe_kit.hooks.contract.declared import Option, answering
from probe_kit.hooks.families.shared.kinds import TOKENIZER_FOLDER, answering_family
from probe_kit.hooks.family_parts import Checkpoints

FAMILIES = (
    answering_family(
        "internvl",
        "InternVL3.5 (InternViT, Qwen3 decoder; pictures as tiles), on transformers' own network",
        "OpenGVLab/InternVL3_5-8B-HF",
        "internvl.adapter:InternVL.load",
        notes="the repositories that end in -HF; 8B 17 GB, 38B 77 GB in bfloat16",
        options=(
            Option(
                "tiles", str, "1: every picture as one tile; auto: as released.", "auto", choices=("auto", "1")
            ),
            TOKENIZER_FOLDER,
        ),
        checkpoints=Checkpoints(
            config_types=("internvl",),
            instead=(
                (
                    "internvl_chat",
                    "It is laid out for its authors' own code; take the repository of the same name that "
                    "ends in -HF",
                ),
            ),
            declared={"8B": answering(37, 4096, 300), "38B": answering(65, 5120, 300)},
            full_size="probe_kit.hooks.families.internvl.network:full_size_internvl",
            parameters={"8B": 8_528_318_464, "38B": 38_390_405_504},
            stored_names="probe_kit.hooks.families.internvl.network:FILE_NAMES",
            sizes=(
                ("8B", "OpenGVLab/InternVL3_5-8B-HF"),
                ("38B", "OpenGVLab/InternVL3_5-38B-HF"),
            ),
        ),
    ),
)
