"""Prismatic vision-language models, native."""

from probe_kit.hooks.contract.options import Option
from probe_kit.hooks.family import Family

TOKENIZER = Option(
    "tokenizer", str, "Folder of another tokenizer; bytes: for development checkpoints.", "the checkpoint's"
)
BITS = Option("bits", int, "Quantised, not exact (extra quantized, GPU).", "none", choices=(4, 8))

FAMILIES = (
    Family(
        "prismatic",
        "Prismatic vision-language models, OpenVLA's source (one or two towers; Llama 2, Vicuna, Mistral, Phi-2)",
        None,
        "probe_kit.hooks.families.prismatic.adapter:load_prismatic",
        streams="backbone 33 layers, answer 33 layers (7B)",
        embodiment="none: answers, does not act",
        packages=(("timm", "openvla"),),
        notes="pass --checkpoint in the layout of PrismaticForConditionalGeneration; extra openvla",
        verifier="probe_kit.hooks.families.prismatic.verify:verify_prismatic",
        config_types=("prismatic", "openvla"),
        needs_checkpoint=True,
        full_size="probe_kit.models.prismatic:full_size_prismatic",
        options=(TOKENIZER, BITS, Option("steps", int, "Greedy tokens per inference.", "1")),
        acts=False,
        reads=True,
    ),
)
