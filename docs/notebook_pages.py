"""An mkdocs hook: shows the notebooks, as they were executed, as pages of the documentation."""

import base64
import json
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

_MOST_LINES = 40
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")


def on_files(files: Files, config: Any, **_: Any) -> Files:
    """Called by mkdocs once it knows its files: adds `notebooks/<name>.md` and its pictures."""
    for path in sorted((Path(config["config_file_path"]).parent / "notebooks").glob("*.ipynb")):
        pictures: dict[str, bytes] = {}
        page = notebook_markdown(path, pictures)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=page))
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def notebook_markdown(path: Path, pictures: dict[str, bytes]) -> str:
    """The cells of a notebook and their outputs as Markdown; its pictures are added to `pictures`, by name."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            # Notebooks are pages beside those of `docs/`, and their links are written for the checkout.
            parts.append(source.replace(".ipynb)", ".md)").replace("](../docs/", "](../"))
            continue
        parts.append(_fenced(source, "python"))
        parts += [_output(output, path.stem, pictures) for output in cell["outputs"]]
    return "\n\n".join(part for part in parts if part) + "\n"


def _output(output: dict[str, Any], stem: str, pictures: dict[str, bytes]) -> str:
    if output["output_type"] == "stream":
        return _fenced("".join(output["text"]), "text")
    if output["output_type"] == "error":
        return _fenced(f"{output['ename']}: {output['evalue']}", "text")
    content = output["data"]
    if "image/png" in content:
        name = f"{stem}-{len(pictures) + 1}.png"
        pictures[name] = base64.b64decode("".join(content["image/png"]))
        return f"![output]({name})"
    if "<table" in "".join(content.get("text/html", "")):
        return f"<div>\n{_unindented(''.join(content['text/html']))}\n</div>"
    if "text/markdown" in content:
        return "".join(content["text/markdown"])
    return _fenced("".join(content.get("text/plain", "")), "text")


def _unindented(html: str) -> str:
    """Without the white space that Markdown would take for code or the end of the table."""
    return "\n".join(line.strip() for line in html.splitlines() if line.strip())


def _fenced(text: str, language: str) -> str:
    lines = _COLOURS.sub("", text).rstrip().splitlines()
    if language == "text" and len(lines) > _MOST_LINES:
        lines = [*lines[:_MOST_LINES], "…"]
    return "\n".join([f"````{language}", *lines, "````"]) if lines else ""
