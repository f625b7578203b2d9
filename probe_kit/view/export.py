"""Export of the viewer: a folder of static files that opens without a server and without a network."""

import shutil
from collections.abc import Collection, Sequence
from pathlib import Path

from probe_kit._system.bounded_files import open_regular
from probe_kit._system.drafts import draft_of
from probe_kit.errors import UnknownCategoryError, UsageError
from probe_kit.runs import Run
from probe_kit.view.catalogue import Catalogue

APP = Path(__file__).parent / "app"
INDEX = "index.html"


def page_files() -> dict[str, bytes]:
    """Return the content of the page's files by their name below the page's address, in order."""
    return {
        path.name if path.name == INDEX else f"app/{path.name}": path.read_bytes()
        for path in sorted(APP.iterdir())
    }


_MARK = "This folder was exported by probe_kit."
README = f"""{_MARK}
Open index.html in a browser; it needs no server and no network.
It holds pictures, instructions and settings of the runs it was made from.
"""


def write_viewer(
    runs: Sequence[Run],
    folder: Path | str,
    *,
    frames: bool = True,
    categories: Collection[str] | None = None,
    probes_of: Run | None = None,
) -> Path:
    """Write the viewer of `runs` to `folder`, whole or not at all, and return its `index.html`.

    The same runs give the same bytes.

    Args:
        runs: The runs of the page.
        folder: Folder of the page; a former export in it is replaced.
        frames: Whether the pictures of the episodes are written.
        categories: Categories whose episodes and maps are written, all by default.
        probes_of: A run of the same model whose probes are shown where a run has none.

    Raises:
        UsageError: Without runs, for a folder that holds anything but a former export, or for probes of another
            model.
        UnknownCategoryError: For a category that no run has.
    """
    folder = Path(folder)
    _check_folder(folder)
    catalogue = Catalogue(runs, probes_of)
    available = {name: None for viewed in catalogue.runs.values() for name in viewed.categories}
    if strange := [name for name in categories or () if name not in available]:
        raise UnknownCategoryError(f"no run has the category {strange[0]!r}; they have {', '.join(available)}")
    with draft_of(folder) as draft:
        draft.mkdir()
        _write(catalogue, draft, frames, categories)
        if folder.exists():
            shutil.rmtree(folder)
        draft.replace(folder)
    return folder / "index.html"


def _check_folder(folder: Path) -> None:
    if not folder.exists():
        return
    if not folder.is_dir():
        raise UsageError(f"{folder} is a file; give a folder")
    names = sorted(entry.name for entry in folder.iterdir())
    readme = folder / "README"
    ours = readme.is_file() and _is_marked(readme)
    if names and not (ours and set(names) <= {"README", "app", "data", "index.html"}):
        raise UsageError(f"{folder} holds {names[0]} and is no former export. Give an empty or a new folder")


def _is_marked(readme: Path) -> bool:
    with open_regular(readme) as file:
        return file.read(len(_MARK.encode())) == _MARK.encode()


def _write(catalogue: Catalogue, folder: Path, frames: bool, categories: Collection[str] | None) -> None:
    (folder / "README").write_text(README, encoding="utf-8", newline="\n")
    for name, content in page_files().items():
        _put(folder / name, content)
    for name in catalogue.names(categories):
        _put(folder / "data" / f"{name}.js", catalogue.script(name))
    for key in catalogue.runs if frames else ():
        for number in catalogue.numbers(key, categories):
            picture = catalogue.picture(key, number)
            if picture is not None:
                _put(folder / "data" / key / "f" / f"{number:05d}.webp", picture)


def _put(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
