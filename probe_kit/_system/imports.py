"""Imports: lazy names of packages, entry points, optional libraries, and the command that installs one."""

import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, lru_cache
from importlib import import_module, metadata
from importlib.util import find_spec
from inspect import getmodulename
from pathlib import Path
from typing import Any

from probe_kit.errors import MissingExtraError


def lazy_names(package: str, homes: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the module-level `__getattr__` and `__dir__` (PEP 562) of `package`.

    `dir`, `help` and the completion of names find `homes` among the names of the package; `dir` imports nothing.

    Args:
        package: The full name of the package, as `__name__` has it.
        homes: The module of every name inside the package; `module:other_name` where it has another name there, or
            `module:` where the name is the module's own. A module of another package begins with `probe_kit.`.
    """

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, colon, original = homes[name].partition(":")
        home = import_module(module if module.startswith("probe_kit.") else f"{package}.{module}")
        return home if colon and not original else getattr(home, original or name)

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return load, names


# -- entry points ---------------------------------------------------------------------------------------------


def entry_points(group: str) -> tuple[metadata.EntryPoint, ...]:
    """Return the entry points of a group, which are read again if a folder of the import path has changed."""
    return tuple(_read(tuple((folder, _modification_time(folder)) for folder in sys.path)).select(group=group))


@lru_cache(maxsize=1)
def _read(_path: tuple[tuple[str, int], ...]) -> metadata.EntryPoints:
    # Reads the metadata of every installed package, which takes 40 ms; a study asks a thousand times.
    return metadata.entry_points()


@contextmanager
def one_scan_of_packages() -> Iterator[None]:
    """Let all imports of the body share one scan of the installed packages.

    transformers and diffusers each map every module to its package when they are imported. Python's own scan asks
    the disk for every file of every package, which takes about a second each time; `packages_by_module` asks for
    none.
    """
    scan = metadata.packages_distributions
    shared = cache(packages_by_module)
    metadata.packages_distributions = lambda: dict(shared())
    try:
        yield
    finally:
        metadata.packages_distributions = scan


def packages_by_module() -> dict[str, list[str]]:
    """Return the names of the installed packages that hold each top-level module, by the name of the module.

    These are those of `importlib.metadata.packages_distributions` (Python 3.12), and those of modules that a
    package lists although they are missing on the disk.
    """
    packages: dict[str, list[str]] = {}
    for package in metadata.distributions():
        for module in _top_level_modules(package):
            packages.setdefault(module, []).append(package.metadata["Name"])
    return packages


def _top_level_modules(package: metadata.Distribution) -> set[str]:
    """Return the modules that a package declares, or else those among the files that it lists."""
    if declared := (package.read_text("top_level.txt") or "").split():
        return set(declared)
    if (listed := package.read_text("RECORD")) is None:
        paths = [str(path) for path in package.files or ()]
    else:
        # Each line holds a path, a hash and a size; a path with a comma is quoted.
        paths = [line.rsplit(",", 2)[0].strip('"') for line in listed.splitlines()]
    parts = {path.partition("/")[:2] for path in paths}
    names = {name if folder else getmodulename(name) or name for name, folder in parts}
    return {name for name in names if "." not in name}


def _modification_time(folder: str) -> int:
    try:
        return Path(folder).stat().st_mtime_ns
    except OSError:  # the import path may name what is not there
        return 0


# -- optional libraries ---------------------------------------------------------------------------------------


def require(module: str, extra: str) -> Any:
    """Return an optional module, or raise MissingExtraError naming the extra of probe-kit that installs it."""
    try:
        return import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"this needs {module.partition('.')[0]}, which is not installed. Install it: "
            f"`{install_command(extra)}`"
        ) from error


# -- commands that install ------------------------------------------------------------------------------------

_ROOT = Path(__file__).parents[2]


def install_command(extra: str = "", rebuild: str = "") -> str:
    """Return the shell command that installs probe_kit again, with an extra or with one package built anew.

    In a checkout's own environment it is `./with-uv`, which brings uv. Elsewhere it is the pip of the running
    Python, or `uv pip` where that Python has none.

    Args:
        extra: The extra of probe-kit; empty for none.
        rebuild: A package that needs numpy while it is compiled; empty for none.
    """
    if _is_of_checkout():
        options = [f"--extra {extra}"] * bool(extra) + [f"--reinstall-package {rebuild}"] * bool(rebuild)
        return " ".join([_with_uv(), *options, "probe-kit doctor"])
    if rebuild:
        again = "--force-reinstall" if _has_pip() else "--reinstall"
        return f"{_installer()} {again} --no-build-isolation {rebuild}"
    name = f"probe-kit[{extra}]" if extra else "probe-kit"
    return f"{_installer()} {shlex.quote(name)}"


def install_folder_command(folder: Path) -> str:
    """Return the shell command that installs the package in `folder` for the running Python, editable."""
    return f"{_installer()} -e {shlex.quote(str(folder))}"


def install_here_command() -> str:
    """Return the shell command that installs the package in the shell's folder, in an activated environment.

    The package stays editable. The command holds on any machine, unless uv is the one that `with-uv` fetched into
    its folder.
    """
    return "pip install -e ." if _has_pip() else f"{_uv()} pip install -e ."


def _is_of_checkout() -> bool:
    """Whether the running Python is the environment that `with-uv` makes in its folder."""
    return (_ROOT / "with-uv").is_file() and Path(sys.prefix).resolve().is_relative_to(_ROOT.resolve())


def _with_uv() -> str:
    return "./with-uv" if Path.cwd() == _ROOT else shlex.quote(str(_ROOT / "with-uv"))


def _has_pip() -> bool:
    return find_spec("pip") is not None


def _installer() -> str:
    if _has_pip():
        return f"{python_command()} -m pip install"
    return f"{_uv()} pip install --python {python_command()}"


def _uv() -> str:
    """Return the uv that a shell finds, or that `with-uv` uses."""
    usual = (Path.home() / ".local/bin/uv", Path.home() / ".cargo/bin/uv", _ROOT / ".uv/bin/uv")
    if shutil.which("uv") is not None:
        return "uv"
    return next((shlex.quote(str(path)) for path in usual if path.is_file()), "uv")


def python_command() -> str:
    """Return the running Python as a shell finds it."""
    name = Path(sys.executable).name
    path = shutil.which(name)
    return name if path is not None and Path(path) == Path(sys.executable) else shlex.quote(sys.executable)
