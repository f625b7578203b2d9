"""The files of the viewer's page: what a browser loads beside the payloads."""

from pathlib import Path

APP = Path(__file__).parent / "app"
INDEX = "index.html"


def page_files() -> dict[str, bytes]:
    """Content of the page's files by their name below the page's address, in order."""
    return {
        path.name if path.name == INDEX else f"app/{path.name}": path.read_bytes()
        for path in sorted(APP.iterdir())
    }
