"""Names of a package that are imported on first use, because their modules load torch or a simulator."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """A module-level `__getattr__` (PEP 562) for `package`.

    homes: name → module inside the package, or `module:other_name` where it is called otherwise there; a module of
    another package begins with `probe_kit.`.
    """

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, original = homes[name].partition(":")
        home = module if module.startswith("probe_kit.") else f"{package}.{module}"
        return getattr(import_module(home), original or name)

    return load
