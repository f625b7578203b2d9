"""Qwen3-VL, on transformers' own network."""

from probe_kit.hooks.contract.declared import answering
from probe_kit.hooks.families.shared.kinds import TOKENIZER_FOLDER, answering_family

FAMILIES = (
    answering_family(
        "qwen3-vl",
        "Qwen3-VL (vision tower with DeepStack, Qwen3 decoder), on transformers' own network",
        "Qwen/Qwen3-VL-8B-Instruct",
        "qwen3_vl.adapter:Qwen3VL.load",
        notes="8B 18 GB, 32B 67 GB in bfloat16; 4B is Xiaomi-R0's source",
        config_types=("qwen3_vl",),
        declared={
            "8B": answering(37, 4096, 110, sums=False),
            "32B": answering(65, 5120, 110, sums=False),
            "4B": answering(37, 2560, 110, sums=False),
        },
        full_size="probe_kit.models.qwen:full_size_qwen3_vl",
        parameters={"8B": 8_767_123_696, "32B": 33_357_390_064, "4B": 4_437_815_808},
        sizes=(
            ("8B", "Qwen/Qwen3-VL-8B-Instruct"),
            ("32B", "Qwen/Qwen3-VL-32B-Instruct"),
            ("4B", "Qwen/Qwen3-VL-4B-Instruct"),
        ),
        options=(TOKENIZER_FOLDER,),
    ),
)
