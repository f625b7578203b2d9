"""pi0 and pi0.5 through lerobot, and the embedded policies, which are pi0 at 0.84 million parameters.

Its page is `docs/pi0.md`; its golden references are `tests/golden/pi0` and `tests/golden/pi05`.
"""

from probe_kit.hooks.contract.card import SourceWeights
from probe_kit.hooks.contract.declared import (
    ACT2ANSWER,
    EMBEDDED,
    OWN_SEEDS,
    Option,
    ProtocolRow,
    backbone,
    expert,
)
from probe_kit.hooks.families.shared.kinds import EVALUATION_OPTIONS, FLOW, lerobot_family
from probe_kit.hooks.family import Family
from probe_kit.hooks.family_parts import Abilities, Checkpoints

_VLM_TINY = SourceWeights(
    sha256="77a4486bf2d356c1e11cfd2a7a0f835683dacf1a7864f714feef92cb19fa0650", parameters=658_944
)


def _embedded_family(name: str, summary: str, notes: str) -> Family:
    """Return one of the embedded policies."""
    return Family(
        name,
        summary,
        None,
        f"probe_kit.hooks.families.pi0.adapter:load_{name.replace('-', '_')}",
        streams="backbone 4 layers, expert 4 layers x 10 iterations",
        notes=notes,
        home=EMBEDDED,
        abilities=Abilities(
            outputs="probe_kit.hooks.families.shared.lerobot.outputs:lerobot_outputs",
            interventions=FLOW,
            vocabulary="probe_kit.models.embedded.words",
        ),
        checkpoints=Checkpoints(config_types=("pi0",), source="vlm-tiny", source_weights=_VLM_TINY),
    )


FAMILIES = (
    _embedded_family(
        "pi0-tiny",
        "pi0 at 0.84 million parameters, the embedded default: vlm-tiny's backbone, acts on Color and Shape",
        "State is readable in its backbone and not acted on; nothing else was trained",
    ),
    _embedded_family(
        "pi0-tiny-early",
        "the embedded default before its training: vlm-tiny's backbone, an expert with random weights",
        "a model organism: see `probe-kit demo --compare`",
    ),
    _embedded_family(
        "pi0-tiny-state",
        "the embedded default, but that it was trained to act on State too",
        "a model organism: see `probe-kit demo --compare`",
    ),
    lerobot_family(
        "pi0",
        "pi0 (PaliGemma 3B + 300M flow-matching expert) through lerobot",
        "juexzz/INTACT-pi0-finetune-bridge",
        "pi0.adapter:Pi0",
        embodiment="WidowX end-effector delta at 5 Hz; other fine-tunes as --checkpoint",
        notes=(
            "Gemma licence; tokenizer google/paligemma-3b-pt-224 is gated. lerobot/pi0_base acts in 32 unnamed "
            "dimensions: --checkpoint lerobot/pi0_base --no-act"
        ),
        options=(
            *EVALUATION_OPTIONS,
            Option("unread", str, "Settings of config.json that change nothing, comma-separated.", "none"),
        ),
        protocols={
            ACT2ANSWER: ProtocolRow(
                "juexzz/INTACT-pi0-finetune-bridge",
                execute=1,
                rotation="axis-angle",
                dtype="bfloat16",
                options={"picture": "squashed", "openness": "release"},
                of_checkpoint={"statistics": "bridge"},
                unmatched=(
                    OWN_SEEDS,
                    "pictures are resized with Lanczos, as INT-ACT resizes one; the release's unpublished fork "
                    "resizes a batch bilinearly",
                    "rotations are converted as INT-ACT's adapter does; the release's fork of it is unpublished",
                ),
            )
        },
        checkpoints=Checkpoints(
            full_size="probe_kit.hooks.families.pi0.network:full_size_pi0",
            hub=(("google/paligemma-3b-pt-224", "tokenizer.json"),),
            source="paligemma",
            source_weights=SourceWeights("google/paligemma-3b-pt-224", parameters=2_923_466_480),
            declared={
                "": (
                    backbone(19, 2048, 304, camera="top"),
                    expert(19, 1024, 10, 5, ("state", "action")),
                )
            },
            parameters={"": 4_028_019_472},
            not_acting=("lerobot/pi0_base",),
        ),
        abilities=Abilities(interventions=FLOW),
    ),
    lerobot_family(
        "pi05",
        "pi0.5 (PaliGemma 3B + 300M flow-matching expert with adaptive norms) through lerobot",
        "lerobot/pi05_base",
        "pi0.adapter:Pi05",
        embodiment="as fine-tuned; the base model acts in 32 unnamed dimensions",
        notes=(
            "Gemma licence; tokenizer google/paligemma-3b-pt-224 is gated. The base can be captured without "
            "acting (--no-act); to act it needs a fine-tune for end-effector deltas. The prompt holds the state "
            "as digits"
        ),
        options=EVALUATION_OPTIONS,
        checkpoints=Checkpoints(
            config_types=("pi05",),
            full_size="probe_kit.hooks.families.pi0.network:full_size_pi05",
            hub=(("google/paligemma-3b-pt-224", "tokenizer.json"),),
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
        ),
        abilities=Abilities(interventions=FLOW),
    ),
)
