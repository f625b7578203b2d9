"""The registry's entry of steer."""

from probe_kit.intervene.kinds.kind import Kind

KIND = Kind(
    name="steer",
    summary="Add a direction to tokens, with controls of the same norm.",
    build="probe_kit.intervene.kinds.steer.intervention:Steering.from_options",
    effects="probe_kit.intervene.kinds.site_effects:measured_patches",
    table="probe_kit.intervene.kinds.site_table:site_table",
    sentences="probe_kit.intervene.kinds.site_table:site_sentences",
    notes="probe_kit.intervene.kinds.site_effects:large_change_notes",
    options={
        "sites": "where tokens are moved; required",
        "roles": "the one whose tokens are moved; required",
        "direction": "mean-difference (default) or probe",
        "controls": "random directions; default 5",
        "coefficients": "in half class-mean differences; default 1,2,4",
        "target_side": "wrong (default), correct, left or right",
        "seed": "of controls and folds; default 0",
    },
    keys_in_use="probe_kit.intervene.results.site_maps:keys_in_use",
)
