"""The registry entry of a kind: data, so that help and tables load nothing that they do not need."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from operator import attrgetter
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True)
class Kind:
    """One kind of intervention; an entry of `registry.KINDS`. Functions are named as `module:function`.

    name: on the command line and in settings. summary: a line of help. options: of sites, roles, direction,
    controls, coefficients, target_side and seed those that it takes, and what each means to it.
    build: (run, **options) → `Intervention`; may load torch. effects: `Measurement` → rows. table: (rows,
    `TableContext`) → table of a terminal. sentences: (rows, `TableContext`) → the finding, one per category.
    notes: (rows, `Measurement`) → what a reader must know, in sentences; may be missing, like `sentences`.
    keys_in_use: run → keys of the stored interventions that tables and figures read; missing if none reads them.
    has_verdict: whether its rows are classified by `classify_use`. is_descriptive: whether it edits nothing and
    tests nothing. asks_where: whether it edits places of the network, so that a line says which layer matters.
    """

    name: str
    summary: str
    build: str
    effects: str
    table: str
    sentences: str = ""
    notes: str = ""
    options: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    keys_in_use: str = ""
    has_verdict: bool = False
    is_descriptive: bool = False
    asks_where: bool = False

    def function(self, part: str) -> Callable[..., Any]:
        """What `build`, `effects`, `table`, `sentences`, `notes` or `keys_in_use` names, imported now."""
        module, _, name = str(getattr(self, part)).partition(":")
        found: Callable[..., Any] = attrgetter(name)(import_module(module))
        return found
