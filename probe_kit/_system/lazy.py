"""Lazy import of public names whose modules load torch or a simulator."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(package: str, homes: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The module-level `__getattr__` and `__dir__` (PEP 562) of `package`.

    `dir`, `help` and the completion of names find `homes` among the names of the package; `dir` imports nothing.
    homes: name → module inside the package, `module:other_name` where it is called otherwise there, or `module:`
    where the name is the module's own; a module of another package begins with `probe_kit.`.
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
