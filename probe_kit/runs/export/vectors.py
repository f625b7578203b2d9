"""The vectors of a run that an export holds, read episode by episode: which sites, and of which tokens."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.hooks.contract.sites import PADDING, Site, plays, resolve_view
from probe_kit.runs.arrays import decode_bfloat16
from probe_kit.runs.layout import ArrayKind, StoredStream
from probe_kit.runs.rows import Rows, Spans
from probe_kit.runs.run import Run

TOKENS: Final = "tokens"
"""The view that has a vector per token; `tokens:ROLE` has those of one role."""
POOLED = -1
"""In place of a token's position."""
_MEAN_OF = "mean:"


@dataclass(frozen=True)
class StreamChoice:
    """Sites of one stream, and the views of them: pooled ones, or one of tokens."""

    stored: StoredStream
    sites: tuple[Site, ...]
    views: tuple[str, ...]

    @property
    def name(self) -> str:
        """The name of the stream."""
        return self.stored.name


@dataclass(frozen=True)
class Block:
    """n vectors of every site of a choice, at one captured inference of one episode.

    position: the episode's place in `Run.episodes`. tokens: (n,) positions, `POOLED` for pooled views. roles: (n,)
    of the tokens; empty for `mean` and `last`, whose tokens play several. values: (S, n, D) float32.
    """

    choice: StreamChoice
    position: int
    inference: int
    view: str
    tokens: NDArray[np.int32]
    roles: tuple[str, ...]
    values: NDArray[np.float32]


def choose(run: Run, sites: Sequence[str] | None, view: str | None) -> tuple[StreamChoice, ...]:
    """The part of a run that is asked for.

    sites: names, their beginnings (`backbone`, `expert.03`) or patterns (`expert.*@9`); None for all. view: a
    pooled view, `tokens` or `tokens:ROLE`; None for all pooled views. Streams without the view are left out unless
    they are named. Raises UnknownSiteError for a site or view that is not stored.
    """
    for pattern in sites or ():
        if not any(_matches(site, [pattern]) for stream in run.streams for site in run.sites(stream)):
            available = ", ".join(f"{run.sites(name)[0]} to {run.sites(name)[-1]}" for name in run.streams)
            raise UnknownSiteError(f"{run.location} has no site {pattern!r}; it has {available}")
    if sites is not None and not sites:
        raise UsageError(
            "no sites are named; expected one or more, such as backbone.07.residual, or all by default"
        )
    choices = []
    for name in run.streams:
        chosen_sites = tuple(site for site in run.sites(name) if sites is None or _matches(site, sites))
        views = _views(run, name, view)
        if chosen_sites and not views and sites is not None:
            available = ", ".join(run.views(name))
            raise UnknownSiteError(
                f"no view {view!r} of {name} in {run.location}; stored: {available}{_tokens(run)}"
            )
        if chosen_sites and views:
            choices.append(StreamChoice(run.stored(name), chosen_sites, views))
    if not choices:
        available = "; ".join(f"{name}: {', '.join(run.views(name))}" for name in run.streams)
        raise UnknownSiteError(
            f"no stream of {run.location} has the view {view!r}; stored are {available}{_tokens(run)}"
        )
    return tuple(choices)


def blocks(run: Run, choices: Sequence[StreamChoice]) -> Iterator[Block]:
    """All vectors, episode by episode and inference by inference. Raises RunDamagedError for damaged bytes."""
    kinds: tuple[ArrayKind, ...] = (TOKENS, *run.root.vector_kinds)
    rows = {
        (choice.name, kind): run.rows(choice.name, kind)
        for choice in choices
        for kind in kinds
        if (kind == TOKENS) == is_tokens(choice.views[0])
    }
    for position, commit in enumerate(run.commits()):
        for choice in choices:
            stream_rows = {kind: rows[choice.name, kind] for kind in kinds if (choice.name, kind) in rows}
            if is_tokens(choice.views[0]):
                yield from _token_blocks(stream_rows[TOKENS], choice, position, commit.roles)
            else:
                yield from _pooled_blocks(run, stream_rows, choice, position, len(commit.roles))


def count_vectors(run: Run, choice: StreamChoice) -> int:
    """Vectors of each site, over all views. Reads no activations."""
    total = 0
    for commit in run.commits():
        for inference, spans in enumerate(commit.roles):
            for view in choice.views:
                if is_tokens(view):
                    total += chosen_tokens(spans[choice.name], view)[0].size
                else:
                    total += view in run.views(choice.name, inference)
    return total


def is_tokens(view: str) -> bool:
    """Whether a view has a vector per token."""
    return view.partition(":")[0] == TOKENS


def chosen_tokens(spans: Spans, view: str) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """(n,) positions and roles of the tokens of a view, `tokens` or `tokens:ROLE`; padding is in none."""
    wanted_role = view.partition(":")[2]
    tokens = [
        (position, role)
        for role, start, stop in sorted(spans, key=lambda span: span[1])
        if (plays(role, wanted_role) if wanted_role else role != PADDING)
        for position in range(start, stop)
    ]
    return np.array([position for position, _ in tokens], np.int32), tuple(role for _, role in tokens)


def _matches(site: Site, patterns: Sequence[str]) -> bool:
    name = str(site)
    return any(
        fnmatchcase(name, pattern) or name.startswith((f"{pattern}.", f"{pattern}@")) for pattern in patterns
    )


def _views(run: Run, stream: str, view: str | None) -> tuple[str, ...]:
    """The views of a stream that are meant; none if it lacks them."""
    pooled = run.views(stream)
    if view is None:
        return pooled
    if is_tokens(view):
        return (view,) if run.settings["tokens"] == "all" and _plays_any(run, stream, view) else ()
    resolved = resolve_view(view, pooled)
    return (resolved,) if resolved in pooled else ()


def _plays_any(run: Run, stream: str, view: str) -> bool:
    return any(chosen_tokens(spans[stream], view)[0].size for commit in run.commits() for spans in commit.roles)


def _tokens(run: Run) -> str:
    if run.settings["tokens"] == "all":
        roles = {
            role
            for commit in run.commits()
            for spans in commit.roles
            for stream_spans in spans.values()
            for role, *_ in stream_spans
        }
        return f", {TOKENS} and {TOKENS}:ROLE of {', '.join(sorted(roles - {PADDING}))}"
    return "; every token only in runs extracted with --tokens all"


def _pooled_blocks(
    run: Run, rows: Mapping[ArrayKind, Rows], choice: StreamChoice, position: int, inferences: int
) -> Iterator[Block]:
    full = rows["pooled"][position]
    later = rows["later"][position] if "later" in rows and inferences > 1 else None
    for inference in range(inferences):
        for view in choice.views:
            if view not in run.views(choice.name, inference):
                continue
            if inference and later is not None:
                vectors: Any = [
                    decode_bfloat16(later[(inference - 1, *choice.stored.at(site))]) for site in choice.sites
                ]
            else:
                index = choice.stored.views.index(view)
                vectors = [full[(inference, *choice.stored.at(site), index)] for site in choice.sites]
            role = view.removeprefix(_MEAN_OF) if view.startswith(_MEAN_OF) else ""
            none = np.array([POOLED], np.int32)
            yield Block(choice, position, inference, view, none, (role,), np.stack(vectors)[:, None])


def _token_blocks(rows: Rows, choice: StreamChoice, position: int, spans: Sequence[Any]) -> Iterator[Block]:
    (view,) = choice.views
    for inference, stream_spans in enumerate(spans):
        tokens, roles = chosen_tokens(stream_spans[choice.name], view)
        if not tokens.size:
            continue
        until = slice(int(tokens.max()) + 1)
        values = np.empty((len(choice.sites), tokens.size, choice.stored.width), np.float32)
        for index, site in enumerate(choice.sites):
            bits = rows.read(position, (inference, *choice.stored.at(site), until))
            values[index] = decode_bfloat16(bits)[tokens]
        yield Block(choice, position, inference, view, tokens, roles, values)
