"""What probes and retention need from a run: nothing but this."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.sites import Site, Stream

if TYPE_CHECKING:
    import pandas as pd


class RunReader(Protocol):
    """A finished or growing run, as `open_run` gives it. Any object with these members will do."""

    @property
    def path(self) -> Path:
        """Folder of the run; probe results go to `path / "probes"`."""

    @property
    def model(self) -> str:
        """Name of the policy."""

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

    def tokens(self, site: Site, role: str | None = None) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """(E, T, D) values and (E, T) mask of one site: the tokens of `role`, or all but padding.

        Every episode has at least one. Raises UnknownSiteError if no tokens were stored.
        """
