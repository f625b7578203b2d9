"""Templates with their styles and scripts: one HTML text with everything in it."""

from pathlib import Path
from typing import Any

from probe_kit._terminal.local_paths import without_places

_HERE = Path(__file__).parent
_ASSETS = {"css": "page.css", "js": "page.js", "episodes_js": "episodes.js"}


def render(template: str, places: tuple[str, ...], **content: Any) -> str:
    """The page; no text in it holds `places` or another absolute path of this machine."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    def shown(value: Any) -> Any:
        if not isinstance(value, str) or isinstance(value, Markup) or value.startswith("data:"):
            return value
        return without_places(value, places)

    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, finalize=shown,
    )  # fmt: skip
    assets = {name: Markup((_HERE / file).read_text(encoding="utf-8")) for name, file in _ASSETS.items()}
    return environment.get_template(template).render(**assets, **content)
