"""The registry's entry of dimmed images."""

from probe_kit.intervene.kinds.kind import Kind

_HERE = "tests.intervene.kinds.dimmed_images"

KIND = Kind(
    name="dimmed-images",
    summary="Take contrast from the image: how far does the action move?",
    build=f"{_HERE}.intervention:DimmedImages.from_options",
    effects=f"{_HERE}.effects:dimmed_effects",
    table=f"{_HERE}.effects:dimmed_table",
    options={"coefficients": "shares of the contrast that stay; default 0"},
)
