"""Changing the streams of one inference, with a ledger of what was changed where, and how far."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, Union

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureError
from probe_kit.hooks.sites import Site

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks import Policy, Tape


@dataclass
class Ledger:
    """What was done in one inference.

    fires: how often an edited site fired. still: of these, the fires that moved nothing. norm, moved: sums over
    fires of the mean norm of the tokens before, and of how far they were moved. largest: of any token.
    """

    fires: int = 0
    still: int = 0
    norm: float = 0.0
    moved: float = 0.0
    largest: float = 0.0

    @classmethod
    def sum(cls, ledgers: Sequence["Ledger"]) -> "Ledger":
        """Of several inferences, or of several streams of one."""
        return cls(
            sum(one.fires for one in ledgers),
            sum(one.still for one in ledgers),
            sum(one.norm for one in ledgers),
            sum(one.moved for one in ledgers),
            max((one.largest for one in ledgers), default=0.0),
        )

    def row(self) -> NDArray[np.float64]:
        """(5,) as stored; `norm` and `moved` per fire."""
        per = max(self.fires, 1)
        return np.array([self.fires, self.still, self.norm / per, self.moved / per, self.largest])


LEDGER = ("fires", "still", "norm", "moved", "largest")
"""What the columns of a stored ledger are."""


Where = Union["Tensor", slice]
"""Positions of tokens: a slice of neighbours, which copies nothing, or (T',) indices."""


class Change(Protocol):
    """What becomes of the tokens of a site."""

    def __call__(self, site: Site, own: "Tensor", where: Where) -> "Tensor":
        """(T', D) float32 tokens in, as many out, and `own` left as it is. where: their positions."""


@dataclass(frozen=True)
class Replaced:
    """By the same tokens of another inference."""

    donor: "Tape"
    tokens: int

    def __call__(self, site: Site, own: "Tensor", where: Where) -> "Tensor":
        """The donor's."""
        del own
        other = self.donor[site][0]
        if other.shape[0] != self.tokens:
            raise CaptureError(
                f"the donor's {site} has {other.shape[0]} tokens; expected {self.tokens}, as before exchanging"
            )
        return other[where].float()


@dataclass(frozen=True)
class ReplacedAlong:
    """By another inference's component along some directions; the rest stays. basis: (K, D) orthonormal."""

    donor: "Tape"
    tokens: int
    basis: NDArray[np.float32]

    def __call__(self, site: Site, own: "Tensor", where: Where) -> "Tensor":
        """own + (donor − own) P."""
        import torch

        apart = Replaced(self.donor, self.tokens)(site, own, where) - own
        directions = torch.from_numpy(self.basis).to(own.device)
        found: Tensor = own + (apart @ directions.T) @ directions
        return found


@dataclass(frozen=True)
class Moved:
    """By a vector (D,), the same for every token."""

    vector: NDArray[np.float32]

    def __call__(self, site: Site, own: "Tensor", where: Where) -> "Tensor":
        """own + vector."""
        import torch

        del site, where
        found: Tensor = own + torch.from_numpy(self.vector).to(own.device)
        return found


@dataclass(frozen=True)
class Kept:
    """As they are: a dose of zero, which is written back like any other."""

    def __call__(self, site: Site, own: "Tensor", where: Where) -> "Tensor":
        """own."""
        del site, where
        return own


@contextmanager
def patched(policy: "Policy", sites: Sequence[Site], mask: NDArray[np.bool_], change: Change) -> Iterator[Ledger]:
    """Change the tokens `mask` (T,) of some sites while the policy infers once, for one observation.

    The ledger is complete when the context is left. Raises CaptureError for another number of tokens, and what
    `hooks.edit` raises, such as for a site that fires another number of times than its tap promises.
    """
    from probe_kit.hooks.capture_context import edit

    ledger, norms = Ledger(), _Norms()
    where = _positions(mask, policy.card.device)
    with edit(policy, {site: _Changer(site, mask.size, where, change, norms) for site in sites}):
        yield ledger
    norms.into(ledger)


def _positions(mask: NDArray[np.bool_], device: str) -> Where:
    import torch

    found = np.flatnonzero(mask)
    if found.size and found.size == found[-1] + 1 - found[0]:
        return slice(int(found[0]), int(found[-1]) + 1)
    return torch.from_numpy(found).to(device)


@dataclass
class _Norms:
    """Per fire the tokens (T', D) before and after; measured and summed up behind the inference, all at once."""

    before: "list[Tensor]" = field(default_factory=list)
    after: "list[Tensor]" = field(default_factory=list)

    def into(self, ledger: Ledger) -> None:
        """Add them up. One transfer for all fires of one shape: a GPU waits at each."""
        import torch

        for shape in dict.fromkeys(tokens.shape for tokens in self.before):
            own = [at for at, tokens in enumerate(self.before) if tokens.shape == shape]
            before, after = (torch.stack([some[at] for at in own]).float() for some in (self.before, self.after))
            norms, moved = (torch.linalg.vector_norm(some, dim=-1) for some in (before, after - before))
            rows = torch.stack([norms.mean(dim=1), moved.mean(dim=1), moved.amax(dim=1)]).tolist()
            for norm, mean, largest in zip(*rows, strict=True):
                ledger.fires += 1
                ledger.still += int(largest == 0)
                ledger.norm += norm
                ledger.moved += mean
                ledger.largest = max(ledger.largest, largest)


@dataclass(frozen=True)
class _Changer:
    site: Site
    tokens: int
    where: Where
    change: Change
    norms: _Norms

    def __call__(self, activation: "Tensor") -> "Tensor":
        if activation.shape[0] != 1 or activation.shape[1] != self.tokens:
            raise CaptureError(
                f"{self.site} passes as {tuple(activation.shape)}; expected one row of {self.tokens} tokens"
            )
        passing = activation[0]
        before = passing[self.where]
        after = self.change(self.site, before.float(), self.where).to(activation.dtype)
        self.norms.before.append(before)
        self.norms.after.append(after)
        if after.shape[0] == self.tokens:
            return after[None]
        # Not in place: neighbours are seen through a view, and what was there is measured later.
        changed = passing.clone()
        changed[self.where] = after
        return changed[None]
