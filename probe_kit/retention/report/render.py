"""Templates with their styles and scripts: one HTML text with everything in it."""

from pathlib import Path
from typing import Any

from probe_kit._tables.html import environment

_HERE = Path(__file__).parent
_ASSETS = {"css": "page.css", "js": "page.js", "episodes_js": "episodes.js"}


def render(template: str, places: tuple[str, ...], **content: Any) -> str:
    """The page; no text in it holds `places` or another absolute path of this machine."""
    from markupsafe import Markup

    assets = {name: Markup((_HERE / file).read_text(encoding="utf-8")) for name, file in _ASSETS.items()}
    return environment(_HERE, places=places).get_template(template).render(**assets, **content)
