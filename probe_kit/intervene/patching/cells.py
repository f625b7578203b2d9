"""Cells by name: the tokens of a role, or at positions, at a place."""

from typing import TYPE_CHECKING

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.views import plays
from probe_kit.intervene.edits.sites import ALL, is_positions, resolve_sites
from probe_kit.intervene.kinds.base import SEPARATOR
from probe_kit.intervene.kinds.joint.cells import Cell

if TYPE_CHECKING:
    from probe_kit.hooks import Model


def find_cells(model: "Model", *patterns: str) -> tuple[Cell, ...]:
    """The cells that patterns of the form `PLACES|ROLES` name, in their order, each once.

    PLACES as for `--sites`: `backbone.*`, `kv.02`, `expert.03@0-4`, `backbone.*.heads.*`. ROLES, separated by
    commas: `all`, roles of the stream's tokens such as `image`, or positions such as `7` or `7-11`; without, all
    tokens. Raises UnknownSiteError for a place that is not there, UsageError for a role that no token can have.
    """
    found = []
    for pattern in patterns:
        places, _, roles = pattern.partition(SEPARATOR)
        for place in resolve_sites(places, model):
            for role in roles.split(",") if roles else (ALL,):
                _check_role(model, place.stream, role.strip())
                found.append(Cell(place, role.strip()))
    if not found:
        raise UsageError("no pattern was given; name cells such as 'backbone.*|image'")
    return tuple(dict.fromkeys(found))


def _check_role(model: "Model", stream: str, role: str) -> None:
    named = model.role_names.get(model.tokens_of(stream), ())
    if role != ALL and not is_positions(role) and not any(plays(name, role) for name in named):
        raise UsageError(
            f"no token of {stream} has the role {role!r}; expected one of {', '.join((ALL, *named))}, or "
            "positions such as 7-11"
        )
