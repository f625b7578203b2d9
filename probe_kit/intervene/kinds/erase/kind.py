"""The registry's entry of erase."""

from probe_kit.intervene.kinds.kind import Kind

KIND = Kind(
    name="erase",
    summary="Remove the decodable answer (weaker than interchange).",
    build="probe_kit.intervene.kinds.erase.intervention:ConceptErasure.from_options",
    effects="probe_kit.intervene.kinds.erase.effects:measured_erasure",
    table="probe_kit.intervene.kinds.erase.table:erasure_table",
    sentences="probe_kit.intervene.kinds.erase.table:erasure_sentences",
    notes="probe_kit.intervene.kinds.erase.effects:erasure_notes",
    options={
        "sites": "where tokens are erased, one site each; required",
        "roles": "of the erased tokens; default image",
        "direction": "leace (default), mean-difference:K or inlp:K, K directions per token",
        "controls": "random subspaces of the same rank; default 5",
        "seed": "of controls and folds; default 0",
    },
)
