"""The files of a run: their names, and how a stream lies in them. Only this package knows them.

RUN/
  run.json           the root: settings, streams, hashes of the plan and of all metadata, and its own
  plan.json          the episodes in order
  commits/<n>.json   one per finished episode, written last: hashes of its objects, and its own
  failed/<n>.json    why an episode was given up; removed when it is tried again
  certificate.json   what was really loaded, and what was checked
  data.zarr/         <stream>/pooled and, with --tokens all, <stream>/tokens
  columns.zarr/      the pooled rows again, by site and view; derived, see `columns`
  sealed/<stamp>.json  hashes of the columns, and of which commits they were made
  probes/            results of `probe-kit train`
  interventions/     results of `probe-kit intervene`
  videos/            GIFs, if asked for
  frames/<n>.webp    first and last frame of an episode, see `thumbnails`

Every object is bound to the root by hashes, see `hashes`.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from probe_kit.hooks.contract.sites import QUANTITIES, Part, Site, Stream

SCHEMA_VERSION = 3
READABLE = (1, 2, 3)
"""Schemas that can be read; only runs of the last one are continued."""
PROTECTED_SINCE = 3
"""From this schema on hashes bind everything to the root."""
TOKEN_BLOCK = 128
RUN_FILE, PLAN_FILE, CERTIFICATE_FILE = "run.json", "plan.json", "certificate.json"
COMMITS, FAILED, DATA, COLUMNS, VIDEOS = "commits", "failed", "data.zarr", "columns.zarr", "videos"
FRAMES, CERTIFICATES, SEALED, PROBES, PROVENANCE = "frames", "certificates", "sealed", "probes", "provenance"
INTERVENTIONS = "interventions"
ILLUSTRATIONS = (FRAMES, VIDEOS)
"""Pictures for people, which a run can do without."""
CODECS = ("zstd", "fast", "none")
CAPTURE_ONLY = "capture_only"
"""Outcome of an episode in which the model was heard and did not act: there is no success rate."""


@dataclass(frozen=True)
class StoredStream:
    """How one stream lies in the store.

    tokens: sequence length T as the model packs it; views: the pooled views V, in storage order.
    """

    name: str
    layers: int
    width: int
    iterations: int | None
    tokens: int
    views: tuple[str, ...]
    part: Part | None = None
    label: str = ""
    quantities: tuple[str, ...] = QUANTITIES
    probed: bool = True
    sums: bool = True

    @classmethod
    def of(cls, stream: Stream, tokens: int, views: tuple[str, ...]) -> "StoredStream":
        """A declared stream, stored."""
        return cls(**{**asdict(stream), "tokens": tokens, "views": views})

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "StoredStream":
        """Read back what `to_json` wrote, in this version or before streams declared their part."""
        lists = {name: tuple(values[name]) for name in ("views", "quantities") if name in values}
        return cls(**{**values, **lists})

    def to_json(self) -> dict[str, Any]:
        """As stored in `run.json`."""
        return {**asdict(self), "views": list(self.views), "quantities": list(self.quantities)}

    @property
    def stream(self) -> Stream:
        """The stream without its storage."""
        return Stream(
            self.name,
            self.layers,
            self.width,
            self.iterations,
            self.part,
            self.label,
            self.quantities,
            self.probed,
        )

    @property
    def lead(self) -> tuple[int, ...]:
        """Axes before the token or view axis: (L,) or (I, L)."""
        return (self.layers,) if self.iterations is None else (self.iterations, self.layers)

    @property
    def dimensions(self) -> tuple[str, ...]:
        """Names of `lead`."""
        return ("layer",) if self.iterations is None else ("iteration", "layer")

    @property
    def token_block(self) -> int:
        """Tokens per inner chunk."""
        return min(TOKEN_BLOCK, self.tokens)

    @property
    def stored_tokens(self) -> int:
        """T rounded up to whole blocks; the rest is zeros."""
        return -(-self.tokens // self.token_block) * self.token_block

    def at(self, site: Site) -> tuple[int, ...]:
        """Index of `site` in the lead axes."""
        return (site.layer,) if site.iteration is None else (site.iteration, site.layer)

    def raw_bytes(self, with_tokens: bool) -> int:
        """Uncompressed bytes of one captured inference."""
        cells = int(np.prod(self.lead)) * self.width
        pooled = cells * len(self.views) * 4
        return pooled + (cells * self.tokens * 2 if with_tokens else 0)
