"""The registry's entry of interchange."""

from probe_kit.intervene.kinds.kind import Kind

KIND = Kind(
    name="interchange",
    summary="Activation patching: where does the swapped image pass?",
    build="probe_kit.intervene.kinds.interchange.intervention:Interchange.from_options",
    effects="probe_kit.intervene.kinds.site_effects:measured_patches",
    table="probe_kit.intervene.kinds.site_table:site_table",
    sentences="probe_kit.intervene.kinds.site_table:site_sentences",
    options={
        "sites": "where tokens are patched; default backbone.*",
        "roles": "of the patched tokens; default all,image,language",
        "direction": "patch within it: mean-difference or probe (mean over tokens), mean-difference:K (tokens)",
        "controls": "random directions; default 5 with --direction",
        "seed": "of controls and folds; default 0",
    },
    keys_in_use="probe_kit.intervene.results.site_maps:keys_in_use",
)
