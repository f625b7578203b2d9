"""The page of commands: the built page has every option, and the file says where they are."""

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


def test_the_file_says_where_the_options_are_and_the_built_page_has_them_all() -> None:
    pages, text = hook(), (DOCS / "commands.md").read_text(encoding="utf-8")
    assert "This file holds the headings alone" in text[:400]
    page = SimpleNamespace(file=SimpleNamespace(src_uri=pages.PAGE))
    built = pages.on_page_markdown(text, page)
    assert "This file holds" not in built
    assert "<!--" not in built
    for path in pages.command_paths():
        assert f"### probe-kit {path}\n" in built, path
        assert pages.command_markdown(path) in built, path
