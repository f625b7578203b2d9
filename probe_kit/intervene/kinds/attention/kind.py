"""The registry's entry of attention."""

from probe_kit.intervene.kinds.kind import Kind

KIND = Kind(
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
)
