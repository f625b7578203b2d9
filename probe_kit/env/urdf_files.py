"""The files that an arm's description names: meshes, their materials and textures. Imports no simulator."""

import re
from collections.abc import Iterator
from pathlib import Path

from probe_kit._system.bounded_files import read_regular

_SCHEMES = ("package://", "model://", "file://")
_NAMED = {
    ".urdf": re.compile(rb"""\bfilename\s*=\s*["']([^"'\r\n]+)["']"""),
    ".obj": re.compile(rb"^[ \t]*mtllib[ \t]+([^\r\n]+)", re.MULTILINE),
    ".mtl": re.compile(rb"^[ \t]*map_\w+[ \t]+(?:-\w+[ \t]+[-\d.]+[ \t]+)*([^\r\n]+)", re.MULTILINE),
    ".dae": re.compile(rb"<init_from>([^<\r\n]+)</init_from>"),
}
"""By suffix, how a file names others. A description may have any suffix and is read as URDF."""


def files_of_description(urdf: Path) -> list[tuple[str, bytes]]:
    """Return the content of an arm's description and of all files that it names, directly or through another.

    Args:
        urdf: The description of the arm.

    Returns:
        By file its name, as the file that names it spells it, and its bytes. The description comes first. A file
        that does not exist is left out: PyBullet says so when it loads the arm.

    Raises:
        OSError: For a file that exists and cannot be read.
    """
    content = read_regular(urdf)
    files = {urdf.resolve(): (urdf.name, content)}
    waiting = list(_named_files(urdf, content, ".urdf"))
    while waiting:
        name, path = waiting.pop(0)
        if path.resolve() in files:
            continue
        content = read_regular(path)
        files[path.resolve()] = (name, content)
        waiting += _named_files(path, content, path.suffix.lower())
    return list(files.values())


def _named_files(path: Path, content: bytes, suffix: str) -> Iterator[tuple[str, Path]]:
    """Yield the names that a file holds, with the files that PyBullet finds for them."""
    if suffix not in _NAMED:
        return
    for match in _NAMED[suffix].finditer(content):
        name = match.group(1).decode("utf-8", "surrogateescape").strip()
        if (file := _find(path.parent.resolve(), name)) is not None:
            yield name, file


def _find(folder: Path, name: str) -> Path | None:
    """Return the file of a name, looked up in a folder and in the folders above it; None if there is none."""
    bare = name
    for scheme in _SCHEMES:
        bare = bare.removeprefix(scheme)
    for parent in (folder, *folder.parents):
        try:
            if (parent / bare).is_file():  # an absolute name stands for itself
                return parent / bare
        except (OSError, ValueError):  # too long, or with a null byte
            return None
    return None
