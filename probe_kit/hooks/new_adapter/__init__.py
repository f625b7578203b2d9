"""Write a package with an adapter that passes the contract tests from the start, for `probe-kit new-adapter`.

The template's network is small, with random weights. While an author fills in their own, the tests stay green step
by step, instead of meeting all of the contract at once.
"""

import keyword
import re
import sys
from importlib.metadata import packages_distributions
from importlib.resources import files
from importlib.resources.abc import Traversable
from importlib.util import find_spec
from pathlib import Path
from string import Template

from probe_kit._system.imports import install_here_command
from probe_kit.errors import UsageError
from probe_kit.hooks.registry import family_names
from probe_kit.version import __version__

_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
_SUFFIX = ".template"
_PACKAGE = "package"


def write_adapter(name: str, folder: Path | str | None = None) -> list[Path]:
    """Write the package of the family `name` into `folder`, by default one of its name, and return its files.

    Raises:
        UsageError: For a name that no family can have or that one has, for that of an installed module, and for a
            folder that holds anything.
    """
    if not _NAME.fullmatch(name) or keyword.iskeyword(name):
        raise UsageError(
            f"{name!r} cannot name a family: expected small letters, digits and hyphens, as in my-vla"
        )
    if name in family_names():
        raise UsageError(f"there is a family {name!r} already; give yours another name")
    module = name.replace("-", "_")
    if origin := _origin(module):
        raise UsageError(
            f"a package {module} would hide the module {module} of {origin}; give yours another name, such as "
            f"my-{name}"
        )
    folder = Path(name if folder is None else folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} holds something already; give a new folder with --out")
    title = "".join(part.capitalize() for part in name.split("-"))
    words = {
        "name": name, "module": module, "Name": title, "version": __version__,
        "install": install_here_command(),
    }  # fmt: skip
    return sorted(_write(files(__name__) / "template", folder, words))


def _origin(module: str) -> str | None:
    """The distribution or the part of Python that has a module of this name; None where there is none."""
    if module in sys.stdlib_module_names or module in sys.builtin_module_names:
        return "Python's standard library"
    if distributions := packages_distributions().get(module):
        return " and ".join(sorted(set(distributions)))
    spec = find_spec(module)
    return None if spec is None or spec.origin is None else str(spec.origin)


def _write(source: Traversable, target: Path, words: dict[str, str]) -> list[Path]:
    written = []
    for entry in source.iterdir():
        if entry.is_dir():
            folder = words["module"] if entry.name == _PACKAGE else entry.name
            written += _write(entry, target / folder, words)
        elif entry.name.endswith(_SUFFIX):
            path = target / entry.name.removesuffix(_SUFFIX)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(Template(entry.read_text(encoding="utf-8")).substitute(words), encoding="utf-8")
            written.append(path)
    return written
