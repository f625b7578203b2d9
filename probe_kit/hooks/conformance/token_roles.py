"""Checks of token roles, compared with what the model computes."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import torch

from probe_kit.hooks.capturing.capture_context import capture
from probe_kit.hooks.conformance.check import CheckFailedError, check, require
from probe_kit.hooks.conformance.subject import Subject
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles, pool
from probe_kit.hooks.contract.views import PADDING, plays, view_names


@check(
    "Roles cover every position and are the declared ones.",
    "Name every role of `roles` in `role_names`, and call no whole row padding.",
)
def roles_cover_every_position_and_are_the_declared_ones(subject: Subject) -> None:
    for name, rows in subject.roles_of(subject.batch).items():
        declared = set(subject.model.role_names[name])
        for row in rows:
            roles = {span.role for span in row.spans}
            require(roles <= declared, f"{name} has the roles {sorted(roles)}", f"some of {sorted(declared)}")
            require(bool(row.valid.any()), f"a row of {name} is padding only", "at least one token")


@check(
    "Another picture moves positions with the role `image` only, at the embeddings.",
    "Correct the order and the numbers of positions in `roles`.",
)
def another_picture_moves_image_positions_only(subject: Subject) -> None:
    observation = subject.observations[0]
    _require_moves(subject, observation, replace(observation, image=255 - observation.image), "image")


@check(
    "Another instruction moves positions with the role `language` only, at the embeddings.",
    "Correct the order and the numbers of positions in `roles`.",
)
def another_instruction_moves_language_positions_only(subject: Subject) -> None:
    observation, other = _alike(subject, subject.alike)
    _require_moves(subject, observation, replace(observation, instruction=other.instruction), "language")


def _alike(subject: Subject, candidates: Sequence[Observation]) -> tuple[Observation, Observation]:
    """The first two whose instructions have equally many tokens."""
    name = subject.probed_backbone.name
    for observation, other in combinations(candidates, 2):
        if (
            subject.roles_of([observation])[name]
            == subject.roles_of([replace(observation, instruction=other.instruction)])[name]
        ):
            return observation, other
    raise CheckFailedError(
        f"no two of the instructions {[candidate.instruction for candidate in candidates]} "
        "have equally many tokens",
        "two that have, so that positions can be compared",
        "Give such instructions: `--instruction` of the command, the fixture `alike` of the contract class.",
    )


def _require_moves(subject: Subject, first: Observation, second: Observation, role: str) -> None:
    """Between two observations with the same roles, only the embeddings of `role` differ, and some do."""
    stream = subject.probed_backbone
    before: Roles = subject.roles_of([first])[stream.name][0]
    site, embeddings = stream.sites()[0], []
    for observation in (first, second):
        with capture(subject.model, [site]) as tape:
            subject.run([observation])
        embeddings.append(tape[site][0].float().cpu())
    moved = (embeddings[0] != embeddings[1]).any(dim=1).numpy() & before.valid
    require(bool(moved.any()), f"another {role} changes nothing at {site}", f"other embeddings of the {role}")
    labels = {span.role for span in before.spans if moved[span.start : span.stop].any()}
    require(
        all(plays(label, role) for label in labels),
        f"another {role} changes positions with the roles {', '.join(sorted(labels))}",
        f"changes at positions with the role {role} only",
    )


@check(
    "Padding enters no pooled view.",
    "Give padded positions the role `padding`.",
)
def padding_is_never_pooled(subject: Subject) -> None:
    for name, rows in subject.roles_of(subject.batch).items():
        for row in rows:
            tokens = torch.ones(len(row), 2)
            tokens[torch.from_numpy(row.mask(PADDING))] = 1e9
            present = {span.role for span in row.spans}
            views = view_names([role for role in subject.model.role_names[name] if role in present])
            pooled = pool(tokens, row, views)
            require(bool((pooled < 2).all()), f"padding enters a view of {name}", "views of real tokens only")
