"""pi0 through lerobot, and the embedded policies, which are pi0 at 0.82 million parameters."""

from probe_kit.hooks.family import Family

_TINY_STREAMS = "backbone 4 layers, expert 4 layers x 10 iterations"
_VERIFIER = "probe_kit.hooks.families.lerobot_verify:verify_pi0"

FAMILIES = (
    Family(
        "pi0-tiny",
        "pi0 at 0.82 million parameters, the embedded default: trained on Color and Shape",
        None,
        "probe_kit.hooks.families.pi0.adapter:load_pi0_tiny",
        streams=_TINY_STREAMS,
        notes="State is readable in its backbone by training, and not acted on; nothing else was trained",
        verifier=_VERIFIER,
        config_types=("pi0",),
    ),
    Family(
        "pi0-tiny-early",
        "the embedded default early in its training",
        None,
        "probe_kit.hooks.families.pi0.adapter:load_pi0_tiny_early",
        streams=_TINY_STREAMS,
        notes="a model organism: see `probe-kit demo --compare`",
        verifier=_VERIFIER,
        config_types=("pi0",),
    ),
    Family(
        "pi0",
        "pi0 (PaliGemma 3B + 300M flow-matching expert) through lerobot",
        "lerobot/pi0_base",
        "probe_kit.hooks.families.pi0.adapter:load_pi0",
        streams="backbone 19 layers, expert 19 layers x 10 iterations",
        embodiment="as fine-tuned; the base model acts in 32 unnamed dimensions",
        hub=(("google/paligemma-3b-pt-224", "tokenizer.json"),),
        notes="Gemma licence; tokenizer google/paligemma-3b-pt-224 is gated",
        verifier=_VERIFIER,
        config_types=("pi0",),
        source="paligemma",
        full_size="probe_kit.models.pi0:full_size_pi0",
    ),
)
