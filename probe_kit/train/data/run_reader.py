"""The protocol of a run: what probes and retention need from it."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.summary import DescribedRun

if TYPE_CHECKING:
    import pandas as pd


def check_several_wordings(episodes: "pd.DataFrame") -> None:
    """Raise UsageError for episodes of several wordings: probes and success rates are of one."""
    if "wording" in episodes and episodes["wording"].nunique() > 1:
        wordings = ", ".join(dict.fromkeys(episodes["wording"].astype(str)))
        raise UsageError(
            f"the episodes were asked in several wordings ({wordings}); probes and success rates take one. Choose "
            "it with --wording NAME, or `run.in_wording(NAME)` in Python"
        )


def seed_text_of(run: DescribedRun) -> str:
    """Return the text that random draws over a run's items are seeded with: its `seed_text`, else its `suite`.

    A reader of one's own need not have a `seed_text`; its suite then sets its draws apart.
    """
    return str(getattr(run, "seed_text", run.suite))


class Tokens(Protocol):
    """Tokens `start` up to `start + T` of all episodes."""

    @property
    def start(self) -> int:
        """First position."""

    @property
    def values(self) -> NDArray[np.float32]:
        """(E, T, D)."""

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(E, T)."""


class RunReader(DescribedRun, Protocol):
    """A finished or growing run, as `open_run` gives it. Any object with these members will do."""

    @property
    def settings_sha256(self) -> str:
        """Hash of the settings the run was extracted with."""

    def views(self, stream: str) -> Sequence[str]:
        """Pooled views stored for `stream`."""

    def sites(self, stream: str) -> Sequence[Site]:
        """Sites stored for `stream`, in order."""

    def column(self, site: Site, view: str) -> NDArray[np.float32]:
        """(E, D) features of one site, rows in the order of `episodes`."""

    def token_mask(self, site: Site, role: str | None = None) -> NDArray[np.bool_]:
        """(E, T): the tokens of `role` at one site, or all but padding. Every episode has at least one.

        Raises UnknownSiteError if no tokens were stored.
        """

    def iter_token_blocks(self, site: Site, role: str | None = None) -> Iterable[Tokens]:
        """Yield the tokens of `token_mask`, some positions of all episodes at a time. Raises UnknownSiteError."""
