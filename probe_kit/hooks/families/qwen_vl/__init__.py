"""Qwen2.5-VL and Qwen3-VL, on transformers' own networks.

Its page is `docs/answer-models.md`. Its golden references are
`tests/golden/vlm/qwen2_5_vl` and `tests/golden/vlm/qwen3_vl`.
"""

from probe_kit.hooks.contract.declared import answering
from probe_kit.hooks.families.shared.kinds import TOKENIZER_FOLDER, answering_family
from probe_kit.hooks.family_parts import Checkpoints

FAMILIES = (
    answering_family(
        "qwen2.5-vl",
        "Qwen2.5-VL (vision tower with windows, Qwen2 decoder), on transformers' own network",
        "Qwen/Qwen2.5-VL-7B-Instruct",
        "qwen_vl.adapter:Qwen25VL.load",
        notes="7B 17 GB, 32B 67 GB in bfloat16; 3B is InternVLA-M1's source",
        options=(TOKENIZER_FOLDER,),
        checkpoints=Checkpoints(
            config_types=("qwen2_5_vl",),
            declared={
                "7B": answering(29, 3584, 110),
                "32B": answering(65, 5120, 110),
                "3B": answering(37, 2048, 110),
            },
            full_size="probe_kit.hooks.families.shared.qwen.network:full_size_qwen2_5_vl",
            parameters={"7B": 8_292_166_656, "32B": 33_452_718_336, "3B": 3_754_622_976},
            stored_names="probe_kit.hooks.families.shared.qwen.network:QWEN2_5_NAMES",
            sizes=(
                ("7B", "Qwen/Qwen2.5-VL-7B-Instruct"),
                ("32B", "Qwen/Qwen2.5-VL-32B-Instruct"),
                ("3B", "Qwen/Qwen2.5-VL-3B-Instruct"),
            ),
        ),
    ),
    answering_family(
        "qwen3-vl",
        "Qwen3-VL (vision tower with DeepStack, Qwen3 decoder), on transformers' own network",
        "Qwen/Qwen3-VL-8B-Instruct",
        "qwen_vl.adapter:Qwen3VL.load",
        notes="8B 18 GB, 32B 67 GB in bfloat16; 4B is Xiaomi-R0's source",
        options=(TOKENIZER_FOLDER,),
        checkpoints=Checkpoints(
            config_types=("qwen3_vl",),
            declared={
                "8B": answering(37, 4096, 110, sums=False),
                "32B": answering(65, 5120, 110, sums=False),
                "4B": answering(37, 2560, 110, sums=False),
            },
            full_size="probe_kit.hooks.families.shared.qwen.network:full_size_qwen3_vl",
            parameters={"8B": 8_767_123_696, "32B": 33_357_390_064, "4B": 4_437_815_808},
            sizes=(
                ("8B", "Qwen/Qwen3-VL-8B-Instruct"),
                ("32B", "Qwen/Qwen3-VL-32B-Instruct"),
                ("4B", "Qwen/Qwen3-VL-4B-Instruct"),
            ),
        ),
    ),
)
