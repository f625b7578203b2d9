"""The page of commands: its file says where the options are. `test_docs` reads the built page."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace
from typing import Any

DOCS = Path(__file__).parents[1] / "docs"


def hook() -> Any:
    spec = importlib.util.spec_from_file_location("commands_page", DOCS / "commands_page.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_file_says_where_the_options_are_and_the_built_page_does_not() -> None:
    pages, text = hook(), (DOCS / "commands.md").read_text(encoding="utf-8")
    assert "This file holds no command" in text[:400]
    page = SimpleNamespace(file=SimpleNamespace(src_uri=pages.PAGE))
    built = pages.on_page_markdown(text, page)
    assert "This file holds" not in built
    assert "<!--" not in built
    assert "### probe-kit suite build\n" in built
