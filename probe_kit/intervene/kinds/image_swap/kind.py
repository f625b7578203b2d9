"""The registry's entry of image swap."""

from probe_kit.intervene.kinds.kind import Kind

KIND = Kind(
    name="image-swap",
    summary="Swap the two images: does the action change sides?",
    build="probe_kit.intervene.kinds.image_swap.intervention:ImageSwap.from_options",
    effects="probe_kit.intervene.kinds.image_swap.effects:measured_image_swap",
    table="probe_kit.intervene.kinds.image_swap.table:image_swap_table",
    sentences="probe_kit.intervene.kinds.image_swap.words:image_swap_sentences",
    keys_in_use="probe_kit.intervene.kinds.image_swap.effects:image_swaps_in_use",
    has_verdict=True,
)
