"""The registry's entry of attribution patching."""

from probe_kit.intervene.kinds.kind import Kind

KIND = Kind(
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
)
