"""The metadata card of a new suite: the content of `suite.json`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import PIL
from PIL import features

from probe_kit.suite.items import SCHEMA_VERSION, Item
from probe_kit.suite.suite import Suite, content_sha256, count_by_category, missing_categories
from probe_kit.version import __version__


def new_suite(
    name: str,
    version: str,
    items: tuple[Item, ...],
    options: Mapping[str, Any],
    extra: Mapping[str, Any] | None = None,
) -> Suite:
    """A suite in memory, ready to be saved; `options` are what it was built or converted with.

    extra: what else its card shall say. The card holds no date: the same options give the same bytes.
    """
    card = {
        "name": name,
        "version": version,
        "schema_version": SCHEMA_VERSION,
        "tool": {"probe_kit": __version__},
        "options": dict(options),
        "counts": count_by_category(items),
        "missing": missing_categories(items),
        "sources": sorted({item.source["benchmark"] for item in items}),
        "curation": sorted({item.curation_status for item in items}),
        "licenses": sorted({item.license for item in items}),
        "contains_real_faces": any(item.contains_real_face for item in items),
        "environment": drawing_libraries(),
        "content_sha256": content_sha256(items, name, version, SCHEMA_VERSION),
        **(extra or {}),
    }
    return Suite(name, version, items, Path(), card)


def drawing_libraries() -> dict[str, str]:
    """Versions that the pixels of a drawn picture can depend on."""
    freetype = features.version("freetype2") or "none"
    return {"pillow": PIL.__version__, "freetype": freetype, "numpy": np.__version__}
