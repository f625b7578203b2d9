"""All kinds of intervention, an entry each. To add one, see "To add a kind of intervention" in CONTRIBUTING.md."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from probe_kit.errors import UsageError
from probe_kit.intervene.kinds.kind import Kind

if TYPE_CHECKING:
    from probe_kit.intervene.replay.conditions import Intervention
    from probe_kit.runs import Run

_ENTRIES = (
    Kind(
        name="image-swap",
        summary="Swap the two images: does the action change sides?",
        build="probe_kit.intervene.kinds.image_swap.intervention:ImageSwap.from_options",
        effects="probe_kit.intervene.kinds.image_swap.effects:measured_image_swap",
        table="probe_kit.intervene.kinds.image_swap.table:image_swap_table",
        sentences="probe_kit.intervene.kinds.image_swap.words:image_swap_sentences",
        keys_in_use="probe_kit.intervene.kinds.image_swap.effects:image_swaps_in_use",
        has_verdict=True,
    ),
    Kind(
        name="instruction-swap",
        summary="Ask for the other picture: does the action change sides?",
        build="probe_kit.intervene.kinds.instruction_swap.intervention:InstructionSwap.from_options",
        effects="probe_kit.intervene.kinds.instruction_swap.effects:instruction_swap_effects",
        table="probe_kit.intervene.kinds.instruction_swap.table:instruction_swap_table",
        sentences="probe_kit.intervene.kinds.image_swap.words:instruction_swap_sentences",
    ),
    Kind(
        name="interchange",
        summary="Activation patching: where does the swapped image pass?",
        asks_where=True,
        build="probe_kit.intervene.kinds.interchange.intervention:Interchange.from_options",
        effects="probe_kit.intervene.kinds.site_effects:measured_patches",
        table="probe_kit.intervene.kinds.site_table:site_table",
        sentences="probe_kit.intervene.kinds.site_table:site_sentences",
        options={
            "sites": "where tokens are patched; default backbone.*",
            "roles": "of the patched tokens; default all,image,language",
            "direction": (
                "patch within it: mean-difference or probe (mean over tokens), mean-difference:K (tokens)"
            ),
            "controls": "random directions; default 5 with --direction",
            "seed": "of controls and folds; default 0",
        },
        keys_in_use="probe_kit.intervene.results.site_maps:keys_in_use",
    ),
    Kind(
        name="joint",
        summary="Patch sets of places: each alone, all but it, smallest set.",
        asks_where=True,
        build="probe_kit.intervene.kinds.joint.intervention:JointPlaces.from_options",
        effects="probe_kit.intervene.kinds.joint.effects:measured_joint_places",
        table="probe_kit.intervene.kinds.joint.table:joint_table",
        sentences="probe_kit.intervene.kinds.joint.table:joint_sentences",
        notes="probe_kit.intervene.kinds.joint.table:few_groups_notes",
        options={
            "sites": "of cells that run in parallel: several blocks of kv, or one layer; default kv.*",
            "roles": "of the cells' tokens; default image,language,state",
            "seed": "of the halves of the groups; default 0",
        },
        keys_in_use="probe_kit.intervene.kinds.joint.effects:joint_keys_in_use",
    ),
    Kind(
        name="attribution",
        summary="Screen by gradients: which places to patch exactly?",
        build="probe_kit.intervene.kinds.attribution.intervention:AttributionPatching.from_options",
        effects="probe_kit.intervene.kinds.attribution.effects:measured_attribution",
        table="probe_kit.intervene.kinds.attribution.table:attribution_table",
        sentences="probe_kit.intervene.kinds.attribution.table:attribution_sentences",
        options={
            "sites": "of the screened cells; default kv.*,backbone.*",
            "roles": "of the cells' tokens; default image,language,state",
            "controls": "cells drawn from the rest that are patched exactly as well; default 20",
            "seed": "of the drawn cells; default 0",
        },
    ),
    Kind(
        name="steer",
        summary="Add a direction to tokens, with controls of the same norm.",
        asks_where=True,
        build="probe_kit.intervene.kinds.steer.intervention:Steering.from_options",
        effects="probe_kit.intervene.kinds.site_effects:measured_patches",
        table="probe_kit.intervene.kinds.site_table:site_table",
        sentences="probe_kit.intervene.kinds.site_table:site_sentences",
        notes="probe_kit.intervene.kinds.site_effects:steering_notes",
        options={
            "sites": "where tokens are moved; required",
            "roles": "the one whose tokens are moved; required",
            "direction": "mean-difference (default), probe or mean-difference:K",
            "controls": "random directions; default 5",
            "coefficients": "in half class-mean differences; default 1,2,4",
            "target_side": "wrong (default), correct, left or right",
            "seed": "of controls and folds; default 0",
        },
        keys_in_use="probe_kit.intervene.results.site_maps:keys_in_use",
    ),
    Kind(
        name="closed-loop",
        summary="Interchange at every inference; whole episodes are played.",
        build="probe_kit.intervene.results.best_targets:build_closed_loop",
        effects="probe_kit.intervene.kinds.closed_loop.effects:measured_closed_loop",
        table="probe_kit.intervene.kinds.closed_loop.table:closed_loop_table",
        sentences="probe_kit.intervene.kinds.closed_loop.table:closed_loop_sentences",
        notes="probe_kit.intervene.kinds.closed_loop.effects:disruption_notes",
        options={
            "sites": "default the last place, of each category, that the newest interchange localised",
            "roles": "with --sites; default all",
            "direction": "patch within it as well: as of interchange, or none; default mean-difference:1",
            "controls": "random directions; default 1",
            "seed": "of controls and folds; default 0",
        },
    ),
    Kind(
        name="erase",
        summary="Remove the decodable answer (weaker than interchange).",
        build="probe_kit.intervene.kinds.erase:ConceptErasure.from_options",
        effects="probe_kit.intervene.kinds.erase:measured_erasure",
        table="probe_kit.intervene.kinds.erase:erasure_table",
        sentences="probe_kit.intervene.kinds.erase:erasure_sentences",
        notes="probe_kit.intervene.kinds.erase:erasure_notes",
        options={
            "sites": "where tokens are erased, one site each; required",
            "roles": "of the erased tokens; default image",
            "direction": "leace (default), mean-difference:K or inlp:K, K directions per token",
            "controls": "random subspaces of the same rank; default 5",
            "seed": "of controls and folds; default 0",
        },
    ),
    Kind(
        name="attention",
        summary="Shares of the acting stream's attention (descriptive).",
        build="probe_kit.intervene.kinds.attention.intervention:AttentionReadout.from_options",
        effects="probe_kit.intervene.kinds.attention.attention_mass:measured_attention",
        table="probe_kit.intervene.kinds.attention.table:attention_table",
        notes="probe_kit.intervene.kinds.attention.attention_mass:attention_notes",
        options={
            "roles": "of the backbone's tokens; default all that the family has",
        },
        keys_in_use="probe_kit.intervene.kinds.attention.attention_mass:attention_in_use",
        is_descriptive=True,
    ),
)
"""In the order of help."""

KINDS: dict[str, Kind] = {kind.name: kind for kind in _ENTRIES}
"""By name. A package of its own registers a kind by adding it here before `probe-kit` is run."""


def kind_of(name: str) -> Kind:
    """The entry of a name. Raises UsageError for one that is not registered."""
    if name not in KINDS:
        raise UsageError(f"unknown kind of intervention {name!r}; expected one of {', '.join(KINDS)}")
    return KINDS[name]


def intervention_of(name: str, run: "Run", common: Mapping[str, Any], given: Mapping[str, Any]) -> "Intervention":
    """As the command asks for it. common: options of every kind. given: further ones, by name.

    Raises UsageError for an option that does not apply to the kind, and what the kind raises.
    """
    kind = kind_of(name)
    check_options(kind, given)
    found: Intervention = kind.function("build")(run, **common, **given)
    found.categories_in(run)
    return found


def check_options(kind: Kind, given: Mapping[str, Any]) -> None:
    """Raise UsageError for an option that does not apply to a kind. given: by name, of the command line."""
    for option in given:
        if option not in kind.options:
            others = [other.name for other in KINDS.values() if option in other.options]
            raise UsageError(
                f"--{option.replace('_', '-')} does not apply to --kind {kind.name}; remove it or choose another "
                f"kind: {', '.join(others)}"
            )
