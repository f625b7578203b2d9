"""Ovis2.5, native."""

from probe_kit.hooks.contract.declared import answering
from probe_kit.hooks.contract.options import Option
from probe_kit.hooks.family import Family

FAMILIES = (
    Family(
        "ovis2.5",
        "Ovis2.5 (SigLIP 2 at any resolution, visual words, Qwen3 decoder), native",
        "AIDC-AI/Ovis2.5-9B",
        "probe_kit.hooks.families.ovis2_5.adapter:Ovis25.load",
        streams="backbone 37 layers, answer 37 layers",
        embodiment="none: answers, does not act",
        notes="asked without its thought; 18 GB in bfloat16",
        outputs="probe_kit.hooks.families.shared.vlm.outputs:vlm_outputs",
        config_types=("ovis2_5",),
        declared={"": answering(37, 4096, 240)},
        full_size="probe_kit.models.ovis2_5:full_size_ovis2_5",
        parameters={"": 9_174_807_784},
        options=(Option("tokenizer", str, "Folder of another tokenizer.json.", "the checkpoint's", is_path=True),),
        acts=False,
        reads=True,
    ),
)
