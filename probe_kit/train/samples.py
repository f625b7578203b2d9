"""The samples of a probe: one per episode or inference (pooled views), or one per token."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NonFiniteActivationError, UnknownSiteError
from probe_kit.hooks.contract.sites import Site, resolve_view
from probe_kit.train.solver.arrays import Array, Features, RowSubset, to_device, to_numpy

if TYPE_CHECKING:
    from probe_kit.runs.arrays import TokenBlock
    from probe_kit.runs.reader import RunReader

TOKENS = "tokens"
"""View in which every valid token is a sample; `tokens:<role>` takes the tokens of one role."""


@dataclass(frozen=True)
class Samples:
    """The features of M samples that belong to E episodes, or to E inferences where each has a label.

    Attributes:
        features: (M, D), the samples of an episode in consecutive rows; tokens are not copied when some are
            chosen.
        counts: (E,) samples per episode.
        means: (E, D) mean sample of every episode. A linear probe's decision on it is the mean of its decisions on
            the samples.
    """

    features: Features
    counts: NDArray[np.intp]
    means: Array

    @classmethod
    def pooled(cls, column: NDArray[np.floating]) -> "Samples":
        """Return one sample per episode, from (E, D)."""
        return cls(column, np.ones(len(column), np.intp), column)

    @classmethod
    def tokens(cls, blocks: "Iterable[TokenBlock]", mask: NDArray[np.bool_]) -> "Samples":
        """Return one sample per token of `mask` (E, T), from blocks of positions; every episode has a token.

        Memory holds one block and the tokens themselves, no padding.
        """
        counts = mask.sum(axis=1)
        row_of = np.cumsum(mask).reshape(mask.shape) - 1
        features: NDArray[np.floating] | None = None
        for block in blocks:
            if features is None:
                features = np.empty((counts.sum(), block.values.shape[-1]), block.values.dtype)
            rows = row_of[:, block.start : block.start + block.mask.shape[1]][block.mask]
            features[rows] = block.values[block.mask]
        assert features is not None, "every episode has a token"
        sums = np.add.reduceat(features, _starts(counts), axis=0, dtype=np.float64)
        return cls(RowSubset.all(features), counts, sums / counts[:, None])

    @classmethod
    def joined(cls, parts: Sequence["Samples"]) -> "Samples":
        """Return the samples of several parts, one part behind the other."""
        pools = all(part.pools for part in parts)
        features = np.concatenate([np.asarray(part.features) for part in parts])
        counts, means = (np.concatenate([getattr(part, name) for part in parts]) for name in ("counts", "means"))
        return cls(features if pools else RowSubset.all(features), counts, means)

    @property
    def pools(self) -> bool:
        """Whether every episode is a single sample."""
        return len(self.counts) == len(self.features)

    def broken(self) -> NDArray[np.intp]:
        """Return the episodes with a NaN or infinite feature: such a sample shows in its episode's mean."""
        means = to_numpy(self.means)
        return np.flatnonzero(~np.isfinite(means).all(axis=1))

    def of(self, episodes: NDArray[np.intp]) -> "Samples":
        """Return the samples of some episodes, in this order."""
        counts = self.counts[episodes]
        shift = _starts(self.counts)[episodes] - _starts(counts)
        rows = np.repeat(shift, counts) + np.arange(counts.sum())
        return Samples(self.features[rows], counts, self.means[episodes])

    def read(self) -> NDArray[np.floating]:
        """Return the features (M, D) in memory."""
        features = self.features.read() if isinstance(self.features, RowSubset) else self.features
        return to_numpy(features)

    def repeat(self, of_episodes: NDArray[Any]) -> NDArray[Any]:
        """Return values of the samples (M, K) from values of their episodes (E, K)."""
        return np.repeat(of_episodes, self.counts, axis=0)

    def to(self, device: str | None) -> "Samples":
        """Return the same with features and means as torch tensors on `device`; unchanged without one."""
        if isinstance(self.features, RowSubset):
            return Samples(self.features.to(device), self.counts, to_device(self.means, device))
        return Samples(to_device(self.features, device), self.counts, to_device(self.means, device))


def sites_of(run: "RunReader", view: str) -> list[Site]:
    """Return the sites of probed streams that have `view`; a role's tokens are where its mean is.

    Raises:
        UnknownSiteError: For a view that no probed stream has.
    """
    probed = [name for name, stream in run.streams.items() if stream.probed]
    if view == TOKENS:
        return [site for stream in probed for site in run.sites(stream)]
    pooled = f"mean:{role_of(view)}" if is_token_view(view) else view
    having = [stream for stream in probed if resolve_view(pooled, run.views(stream)) in run.views(stream)]
    sites = [site for stream in having for site in run.sites(stream)]
    if not sites:
        views = sorted({name for stream in run.streams for name in run.views(stream)})
        raise UnknownSiteError(
            f"{run.location} has no view {view!r}; it has: {', '.join(views)}, and with stored tokens: {TOKENS} "
            f"or {TOKENS}:ROLE for every mean:ROLE"
        )
    return sites


def is_token_view(view: str) -> bool:
    """Whether every token is a sample in `view`."""
    return view.partition(":")[0] == TOKENS


def role_of(view: str) -> str | None:
    """Return the role whose tokens a token view takes, None for all but padding."""
    return view.partition(":")[2] or None


def read_samples(
    run: "RunReader", view: str, site: Site, rows: NDArray[np.intp], inferences: NDArray[np.intp]
) -> Samples:
    """Return the samples of one site, in order: episode `rows` (n,) of the run at captured `inferences` (n,).

    Raises:
        NonFiniteActivationError: For NaN or infinity; the message names the first broken sample.
    """
    parts, order = [], []
    for call in np.unique(inferences).tolist():
        places = np.flatnonzero(inferences == call)
        parts.append(_read_call(run, view, site, rows[places], call))
        order.append(places)
    samples = parts[0] if len(parts) == 1 else Samples.joined(parts).of(np.argsort(np.concatenate(order)))
    if (broken := samples.broken()).size:
        first, names = int(broken[0]), run.episodes["episode_id"]
        raise NonFiniteActivationError(
            f"{site}, view {view!r}, of {run.location} holds NaN or infinity in {broken.size} of {rows.size} "
            f"samples, the first inference {inferences[first]} of {names.iloc[int(rows[first])]!r}; expected "
            "finite features. Extract these episodes again"
        )
    return samples


def _read_call(run: "RunReader", view: str, site: Site, rows: NDArray[np.intp], call: int) -> Samples:
    """Return one captured inference of some episodes.

    The number of the inference is passed to the reader only from the second one on: a reader may have one alone.
    """
    at = (call,) if call else ()
    if not is_token_view(view):
        return Samples.pooled(run.column(site, view, *at)[rows])
    role = role_of(view)
    blocks, mask = run.iter_token_blocks(site, role, *at), run.token_mask(site, role, *at)
    if np.array_equal(rows, np.arange(len(mask))):
        return Samples.tokens(blocks, mask)
    some = (replace(block, values=block.values[rows], mask=block.mask[rows]) for block in blocks)
    return Samples.tokens(some, mask[rows])


def _starts(counts: NDArray[np.intp]) -> NDArray[np.intp]:
    starts: NDArray[np.intp] = np.cumsum(counts) - counts
    return starts
