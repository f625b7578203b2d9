"""`ArrayRun`, a run made of arrays in memory, for activations that were not recorded by probe_kit."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.runs.run_source import Origin, RunSource
from probe_kit.runs.store import Location, locate

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.runs.arrays import StoredInputs, TokenBlock


@dataclass(frozen=True)
class ArrayRun:
    """A run over features in memory, for activations that were not recorded by probe_kit.

    Attributes:
        path: The folder for the probe results.
        model: The model's name, which labels the run.
        suite: The suite's name, from which the seeds of draws derive.
        episodes: One row per episode, with at least `episode_id`, `item_id`, `category`, `group_id`, `layout`,
            `side_correct`, `outcome` and `side_placed`.
        features: (E, D) per site and view, rows in the order of `episodes`.
        weights_sha256: The hash of the model's weights; None if it is unknown.
        token_features: Per site and role (None for all tokens), (E, T, D) values and (E, T) mask. A site needs a
            pooled view too.
        control_features: (E, D) by name, of controls of a label that never saw the model.

    Raises:
        UsageError: If an array has another number of rows or dimensions.
    """

    path: Path
    model: str
    suite: str
    episodes: "pd.DataFrame"
    features: Mapping[tuple[Site, str], NDArray[np.floating]]
    random_weights: bool = False
    weights_sha256: str | None = None
    token_features: Mapping[tuple[Site, str | None], tuple[NDArray[np.floating], NDArray[np.bool_]]] = field(
        default_factory=dict
    )
    control_features: Mapping[str, NDArray[np.floating]] = field(default_factory=dict)

    # Parts of a run that arrays in memory do not have.
    recorded: ClassVar[bool] = False
    in_own_environment: ClassVar[bool] = False
    inputs: ClassVar["StoredInputs | None"] = None
    captured_calls: ClassVar[int] = 1
    has_trajectories: ClassVar[bool] = False
    lens_margins: ClassVar[NDArray[np.float64] | None] = None
    settings: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    certificate: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    mixed: ClassVar[Sequence[str]] = ()
    origins: ClassVar[Sequence[Origin]] = ()
    stamp: ClassVar[str] = ""
    suite_parent: ClassVar[str | None] = None
    items: ClassVar["pd.DataFrame | None"] = None
    planned_ids: ClassVar[Collection[str]] = ()
    failed: ClassVar[Mapping[str, str]] = MappingProxyType({})
    wording: ClassVar[str | None] = None
    wordings: ClassVar[Sequence[str]] = ()
    rule: ClassVar[str] = "disc"  # the rule by which outcomes are stored; its module needs a scene
    score: ClassVar[str] = "text"
    viewed: ClassVar["ArrayRun | None"] = None

    def __post_init__(self) -> None:
        arrays = {f"features of {site}, view {view!r},": array for (site, view), array in self.features.items()}
        arrays |= {f"features of the control {name!r}": array for name, array in self.control_features.items()}
        for what, array in arrays.items():
            if array.ndim != 2 or len(array) != len(self.episodes):
                raise UsageError(
                    f"{what} have shape {array.shape}; expected ({len(self.episodes)}, D), one row per episode"
                )

    @property
    def label(self) -> str:
        """The model's name."""
        return self.model

    @property
    def location(self) -> Location:
        """The folder `path`."""
        return locate(self.path)

    @property
    def ask(self) -> Mapping[str, Any] | None:
        """The settings with which its model was asked; None for one that acts."""
        return self.settings.get("ask")

    @property
    def source(self) -> RunSource:
        """The source that names its suite."""
        return RunSource("arrays", self.suite, f"it is made of arrays on {self.suite}")

    @property
    def seed_text(self) -> str:
        """The suite's name, which makes its draws differ from those of other suites."""
        return self.suite

    @property
    def all_wordings(self) -> Self:
        """The run itself, which has no wordings."""
        return self

    @property
    def planned(self) -> int:
        """The number of its episodes."""
        return len(self.episodes)

    @property
    def planned_items(self) -> Mapping[str, str]:
        """The category of every item of its episodes, by item id."""
        return dict(zip(self.episodes["item_id"], self.episodes["category"], strict=True))

    @property
    def control_steps(self) -> NDArray[np.int64]:
        """An array (E, 0): inferences in memory have no steps."""
        return np.zeros((len(self.episodes), 0), np.int64)

    @cached_property
    def settings_sha256(self) -> str:
        """The hash of all features: other arrays are another run."""
        pooled = [[str(site), view, _sha256(array)] for (site, view), array in self.features.items()]
        tokens = [
            [str(site), f"tokens:{role}", _sha256(values), _sha256(mask)]
            for (site, role), (values, mask) in self.token_features.items()
        ]
        controls = [[name, "control", _sha256(array)] for name, array in self.control_features.items()]
        return sha256_json(sorted(pooled) + sorted(tokens) + sorted(controls))

    def reached(self, call: int) -> NDArray[np.bool_]:
        """Return for every episode (E,) whether it has inference `call`: all have the only one, 0."""
        return np.full(len(self.episodes), call == 0)

    @property
    def streams(self) -> Mapping[str, Stream]:
        """The streams by name, as far as their sites have features."""
        return {name: self._stream(name) for name in dict.fromkeys(site.stream for site, _ in self.features)}

    def views(self, stream: str) -> Sequence[str]:
        """Return the views of a stream."""
        return list(dict.fromkeys(view for site, view in self.features if site.stream == stream))

    def sites(self, stream: str) -> Sequence[Site]:
        """Return the sites of a stream, in the order of `features`."""
        return list(dict.fromkeys(site for site, _ in self.features if site.stream == stream))

    def column(self, site: Site, view: str) -> NDArray[np.float32]:
        """Return the features (E, D) of one site. Raises UnknownSiteError if there are none of the view."""
        if (site, view) not in self.features:
            raise UnknownSiteError(f"there are no features of {site}, view {view!r}")
        return self.features[site, view].astype(np.float32)

    def tokens(self, site: Site, role: str | None = None) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return values (E, T, D) and mask (E, T) of one site. Raises UnknownSiteError if there are none."""
        if (site, role) not in self.token_features:
            raise UnknownSiteError(f"there are no tokens of {site}, role {role!r}")
        values, mask = self.token_features[site, role]
        return values.astype(np.float32), mask

    def token_mask(self, site: Site, role: str | None = None) -> NDArray[np.bool_]:
        """Return the mask (E, T) of one site. Raises UnknownSiteError if there are no tokens of the role."""
        return self.tokens(site, role)[1]

    def iter_token_blocks(self, site: Site, role: str | None = None) -> Iterator["TokenBlock"]:
        """Yield all tokens of one site as one block, since they are in memory. Raises UnknownSiteError."""
        from probe_kit.runs.arrays import TokenBlock

        yield TokenBlock(0, *self.tokens(site, role))

    def _stream(self, name: str) -> Stream:
        sites = [(site, array) for (site, _), array in self.features.items() if site.stream == name]
        steps = {site.iteration for site, _ in sites} - {None}
        return Stream(
            name,
            layers=1 + max(site.layer for site, _ in sites),
            width=sites[0][1].shape[1],
            iterations=len(steps) or None,
        )


def _sha256(array: NDArray[np.generic]) -> str:
    return sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
