"""Cells: the tokens of roles at places, patched together in one inference."""

from collections.abc import Mapping
from dataclasses import dataclass

from probe_kit.hooks.capturing.edit_engine import apply_patches
from probe_kit.hooks.capturing.token_edits import ReplaceWith, TokenEdit, TokenSelection
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.edits.sites import SiteGroup
from probe_kit.intervene.kinds.interchange.intervention import source_of
from probe_kit.intervene.replay.conditions import ConditionContext, ConditionResult
from probe_kit.intervene.replay.image_tokens import role_tokens


@dataclass(frozen=True)
class Cell:
    """The tokens of one role at one place."""

    place: SiteGroup
    role: str

    def __str__(self) -> str:
        return f"{self.place.name} {self.role}"


@dataclass(frozen=True)
class CellsPatched:
    """The clean inference with all these cells from the inference with swapped images.

    cells: by category, and for all other categories under the empty name. sources: see `PatchedFromSource`.
    """

    name: str
    cells: Mapping[str, tuple[Cell, ...]]
    source_sites: tuple[Site, ...]

    def play(self, context: ConditionContext) -> ConditionResult:
        """One inference, however many cells."""
        session, replay_input = context.session, context.replay_input
        cells = self.cells.get(replay_input.category, self.cells.get("", ()))
        if not cells:
            return ConditionResult(session.act(replay_input.seen, replay_input.seed))
        source = source_of(context, self.source_sites)
        changes: dict[Site, list[tuple[TokenSelection, TokenEdit]]] = {}
        for cell in cells:
            tokens = role_tokens(session.policy, replay_input, cell.place.stream, cell.role, context.memo)
            for site in cell.place.sites:
                change = cell.place.limit(ReplaceWith(source, tokens.count))
                changes.setdefault(site, []).append((tokens, change))
        with apply_patches(session.policy, changes) as edit_log:
            chunk = session.act(replay_input.seen, replay_input.seed)
        return ConditionResult(chunk, edit_log)


def all_but(cells: tuple[Cell, ...], left_out: tuple[Cell, ...]) -> tuple[Cell, ...]:
    """The cells without some of them, in their order."""
    return tuple(cell for cell in cells if cell not in left_out)
