"""PaliGemma, on transformers' own network, and the embedded VLM of 0.61 million parameters.

Its page is `docs/answer-models.md`; its golden reference is `tests/golden/vlm/paligemma`.
"""

from probe_kit.hooks.contract.declared import EMBEDDED, answering
from probe_kit.hooks.families.shared.kinds import TOKENIZER_FOLDER, answering_family
from probe_kit.hooks.family_parts import Abilities, Checkpoints

FAMILIES = (
    answering_family(
        "vlm-tiny",
        "PaliGemma at 0.61 million parameters, the embedded VLM: knows Color, Shape, State and Traffic",
        None,
        "paligemma.adapter:load_vlm_tiny",
        streams="backbone 4 layers, answer 4 layers",
        notes="its words are those of the embedded suite and of the prompts of `probe-kit ask`; no others",
        home=EMBEDDED,
        checkpoints=Checkpoints(config_types=("paligemma",)),
        abilities=Abilities(vocabulary="probe_kit.models.embedded.words"),
    ),
    answering_family(
        "paligemma",
        "PaliGemma 3B (SigLIP, Gemma 2B; the prompt attends both ways), pi0's source",
        "google/paligemma-3b-pt-224",
        "paligemma.adapter:PaliGemma.load",
        notes="Gemma licence, gated; pt, not mix: it was not trained to follow instructions; 5.9 GB in bfloat16",
        options=(TOKENIZER_FOLDER,),
        checkpoints=Checkpoints(
            config_types=("paligemma",),
            declared={"": answering(19, 2048, 290)},
            full_size="probe_kit.hooks.families.paligemma.network:full_size_paligemma",
            parameters={"": 2_923_466_480},
            stored_names="probe_kit.hooks.families.paligemma.network:FILE_NAMES",
        ),
    ),
)
