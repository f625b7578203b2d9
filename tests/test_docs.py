"""The documentation builds without a warning, fetches nothing, and names every command, option and error."""

import inspect
import os
import re
import runpy
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from markdown.extensions.toc import slugify

from probe_kit import errors
from probe_kit.cli import app, commands_of

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = {
    path.relative_to(DOCS).as_posix(): path.read_text(encoding="utf-8") for path in sorted(DOCS.rglob("*.md"))
}
"""The text of every page by its path in the folder."""
ERRORS = [
    error
    for _, error in inspect.getmembers(errors, inspect.isclass)
    if issubclass(error, errors.ProbeKitError) and error is not errors.ProbeKitError
]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    built = subprocess.run(
        command, cwd=ROOT, capture_output=True, encoding="utf-8", check=False, timeout=300,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr
    return folder


def test_the_architecture_page_names_files_that_exist() -> None:
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    file_names = re.findall(r"`([a-z0-9_/]+(?:\.py|/))`", page)
    file_names = [name for name in file_names if not name.startswith(("probe_kit", "tests"))]
    assert len(file_names) > 40
    assert [name for name in file_names if not (ROOT / "probe_kit" / name).exists()] == []


@pytest.mark.slow
def test_every_page_of_the_folder_is_built(site: Path) -> None:
    pages = {path.stem for path in DOCS.glob("*.md")}
    assert pages <= {path.stem for path in site.glob("*.html")}
    assert len(list((site / "notebooks").glob("*.html"))) == len(list((ROOT / "notebooks").glob("*.ipynb")))
    assert list((site / "notebooks").glob("*.png"))


@pytest.mark.slow
def test_a_readers_browser_fetches_nothing_from_elsewhere(site: Path) -> None:
    loading = re.compile(r"<(?:script|img|iframe|link)[^>]*(?:src|href)=\"(https?:)?//[^\"]*\"[^>]*>")
    fetched = {tag for page in site.rglob("*.html") for tag in loading.findall(page.read_text(encoding="utf-8"))}
    assert not fetched


def pages_in(entry: Any) -> list[str]:
    """The files of a part of the navigation of mkdocs.yml."""
    if isinstance(entry, str):
        return [entry]
    return [page for part in (entry.values() if isinstance(entry, dict) else entry) for page in pages_in(part)]


def test_every_page_and_notebook_stands_in_the_navigation_once() -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    listed = pages_in(yaml.safe_load(text[text.index("\nnav:") :])["nav"])
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert sorted(listed) == sorted(PAGES.keys() | notebooks)


def without_code(markdown: str) -> str:
    return re.sub(r"^```.*?^```", "", markdown, flags=re.MULTILINE | re.DOTALL)


def headings(page: str) -> set[str]:
    """The anchors of a page's headings, as the site makes them."""
    return {slugify(title, "-") for title in re.findall(r"^#+ (.*)$", without_code(PAGES[page]), re.MULTILINE)}


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_to_a_file_and_to_a_heading_of_it(page: str) -> None:
    """Those of the built reference are checked by mkdocs, in the slow tests."""
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", without_code(PAGES[page])):
        if re.match(r"[a-z]+:", link):
            continue
        target, _, heading = link.partition("#")
        file = (DOCS / page).parent / target if target else DOCS / page
        if "notebooks" in file.parts:
            file = ROOT / "notebooks" / f"{file.stem}.ipynb"
        name = file.resolve().relative_to(DOCS).as_posix() if file.resolve().is_relative_to(DOCS) else ""
        if not file.is_file() or (heading and heading not in headings(name)):
            broken.append(link)
    assert not broken


def test_every_command_and_option_stands_on_the_page_of_commands() -> None:
    commands_page = runpy.run_path(str(DOCS / "commands_page.py"))["commands_markdown"]()
    options = 0
    for path, command in commands_of(typer.main.get_command(app), None):
        (section,) = re.findall(rf"^### probe-kit {path}$(.*?)(?=^##|\Z)", commands_page, re.MULTILINE | re.DOTALL)
        for parameter in command.params:
            option = (
                (*parameter.secondary_opts, *parameter.opts)[-1]
                if parameter.param_type_name == "option"
                else parameter.name.upper()
            )
            assert option == "--help" or re.search(rf"(?<![\w-]){option}(?![\w-])", section), f"{path} {option}"
            options += 1
    assert options > 80


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: error.__name__)
def test_every_error_has_its_exit_code_and_a_cause_or_a_place_to_look(error: type[errors.ProbeKitError]) -> None:
    page = (DOCS / "errors.md").read_text(encoding="utf-8")
    (row,) = re.findall(rf"^\| `{error.__name__}` \|(.*)\|$", page, re.MULTILINE)
    code, cause = (cell.strip() for cell in re.split(r"(?<!\\)\|", row))
    assert int(code) == error.exit_code
    assert len(cause) > 20


def test_the_page_of_errors_names_no_error_that_is_none() -> None:
    page = (DOCS / "errors.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| `(\w+Error)`", page, re.MULTILINE)) == {error.__name__ for error in ERRORS}


def test_every_family_that_acts_has_a_row_on_the_page_of_families() -> None:
    from probe_kit.hooks.registry import own_families

    page = (DOCS / "families.md").read_text(encoding="utf-8")
    family_names = {
        name
        for line in re.findall(r"^\| (`[^|]*) \|", page, re.MULTILINE)
        for name in re.findall(r"`([^`]+)`", line)
    }
    acting = {name for name, family in own_families().items() if family.abilities.acts}
    assert acting - {"pi0-tiny-early", "pi0-tiny-state"} - family_names == set()


def test_every_public_name_is_described_in_the_reference() -> None:
    import probe_kit

    reference = _reference()
    described = {_resolved(path) for path in reference}
    missing = [name for name in probe_kit.__all__ if getattr(probe_kit, name) not in described]
    # Errors are described on a page of their own, with all of their children; functions of patching one by one.
    assert missing == ["ProbeKitError", "patching"]
    assert {getattr(probe_kit.patching, name) for name in probe_kit.patching.__all__} - described <= {
        probe_kit.hooks.logit_lens, probe_kit.hooks.project_heads,
    }  # fmt: skip


def test_the_reference_knows_names_of_packages_only() -> None:
    """The file of a name inside its package is private."""
    reference = _reference()
    modules = [import_module(path.rpartition(".")[0]) for path in reference]
    assert len(reference) > 40
    assert [module.__name__ for module in modules if not hasattr(module, "__path__")] == []


def _reference() -> list[str]:
    """What the pages of the reference describe, by its full name."""
    pages = sorted((DOCS / "api").glob("*.md"))
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    return re.findall(r"^::: (.+)$", text, re.MULTILINE)


def _resolved(path: str) -> object:
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)
