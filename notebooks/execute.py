"""Execute the notebooks and keep their outputs: `./with-uv python notebooks/execute.py [NAME ...]`.

They run in one temporary folder, in order, so that they share what they make and know no path of this machine.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import nbformat
from jupyter_client.manager import KernelManager
from nbclient import NotebookClient
from nbformat import NotebookNode

from probe_kit._terminal.notebook import PROGRESS_MARK

FOLDER = Path(__file__).parent


def notebooks() -> list[Path]:
    """All notebooks, in the order in which they are meant to be read."""
    return sorted(FOLDER.glob("*.ipynb"))


@contextmanager
def kernel(folder: Path) -> Iterator[KernelManager]:
    """A kernel in `folder` for several notebooks: what one imported, the next need not import again."""
    manager = KernelManager()
    manager.start_kernel(cwd=str(folder))
    try:
        yield manager
    finally:
        manager.shutdown_kernel(now=True)


def _forget_names(manager: KernelManager) -> None:
    """No notebook sees what another one called something."""
    client = manager.client()
    client.start_channels()
    try:
        client.wait_for_ready(timeout=120)
        client.execute("%reset -f", reply=True, timeout=120)
    finally:
        client.stop_channels()


def executed(path: Path, folder: Path, manager: KernelManager | None = None) -> NotebookNode:
    """The notebook with fresh outputs, run from top to bottom in `folder`.

    manager: a `kernel` that is running; None for one of its own. Raises CellExecutionError where a cell raises.
    """
    notebook = nbformat.read(path, as_version=4)
    metadata = dict(notebook.metadata)
    options: dict[str, Any] = {"timeout": 600, "record_timing": False, "coalesce_streams": True}
    if manager is not None:
        _forget_names(manager)
        options["km"] = manager
    NotebookClient(notebook, resources={"metadata": {"path": str(folder)}}, **options).execute()
    notebook.metadata = metadata
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if _clean(output, f"{folder}/")]
    return notebook


def _clean(output: NotebookNode, folder: str) -> bool:
    """Take the folder's own path out of an output; whether anything is left."""
    if output.output_type == "stream":
        output.text = output.text.replace(folder, "")
        return bool(output.text.strip())
    content = output.get("data", {})
    if PROGRESS_MARK in content.get("text/html", ""):
        return False  # how long it took here
    content.pop("image/jpeg", None)  # beside the same picture as PNG
    for kind in ("text/plain", "text/html"):
        if kind in content:
            content[kind] = content[kind].replace(folder, "")
    return True


def main(names: list[str]) -> None:
    """Execute all notebooks, or those whose names begin so, and write them back."""
    with TemporaryDirectory() as folder:
        for path in notebooks():
            if not names or path.name.startswith(tuple(names)):
                print(path.name, file=sys.stderr)
                nbformat.write(executed(path, Path(folder)), path)


if __name__ == "__main__":
    main(sys.argv[1:])
