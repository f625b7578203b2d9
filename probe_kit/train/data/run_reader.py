"""The protocol of a run: what probes and retention need from it."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.extract.store.locations.location import Location
from probe_kit.hooks.contract.sites import Site, Stream

if TYPE_CHECKING:
    import pandas as pd


def check_several_wordings(episodes: "pd.DataFrame") -> None:
    """Raise UsageError for episodes of several wordings: probes and success rates are of one."""
    if "wording" in episodes and episodes["wording"].nunique() > 1:
        there = ", ".join(dict.fromkeys(episodes["wording"].astype(str)))
        raise UsageError(
            f"the episodes were asked in several wordings ({there}); probes and success rates take one. Choose it "
            "with --wording NAME, or `run.in_wording(NAME)` in Python"
        )


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


class RunReader(Protocol):
    """A finished or growing run, as `open_run` gives it. Any object with these members will do."""

    @property
    def location(self) -> Location:
        """Where the run lies; probe results go to `probes` there. For a folder: `locate(folder)`."""

    @property
    def model(self) -> str:
        """Name of the policy."""

    @property
    def label(self) -> str:
        """What tables and legends call the run; two runs of one model differ in it."""

    @property
    def weights_sha256(self) -> str | None:
        """Hash of the weights that acted; None for a policy without weights."""

    @property
    def random_weights(self) -> bool:
        """Whether the policy was never trained; marked in every table and figure."""

    @property
    def suite(self) -> str:
        """Identity of the suite, `name@version#hash`."""

    @property
    def settings_sha256(self) -> str:
        """Hash of the settings the run was extracted with."""

    @property
    def episodes(self) -> "pd.DataFrame":
        """One row per finished episode, with at least `episode_id`, `item_id`, `category`, `group_id`,
        `layout`, `side_correct`, `outcome` and `side_placed`.
        """

    @property
    def streams(self) -> Mapping[str, Stream]:
        """Captured streams by name; empty for a policy without activations."""

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
        """Those tokens, some positions of all episodes at a time. Raises UnknownSiteError as `token_mask`."""
