"""The files of a run: names, array shapes, codec. Only this package knows them.

    RUN/
      run.json           settings and the sha256 of their canonical form
      plan.json          the episodes in order
      commits/<n>.json   one per finished episode, written last
      failed/<n>.json    why an episode was given up; removed when it is tried again
      certificate.json   what was really loaded, and what was checked
      data.zarr/         <stream>/pooled and, with --tokens all, <stream>/tokens
      columns.zarr/      the pooled rows again, by site and view; derived, see `columns`
      probes/            results of `probe-kit train`
      videos/            GIFs, if asked for
      frames/<n>.webp    first and last frame of an episode, see `thumbnails`

Token arrays hold the bits of bfloat16 as uint16, because Zarr v3 has no bfloat16.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.codec import BytesBytesCodec
from zarr.abc.store import Store
from zarr.codecs import BloscCodec, Crc32cCodec

from probe_kit.hooks.sites import Site, Stream

if TYPE_CHECKING:
    from probe_kit.extract.store.location import Location

SCHEMA_VERSION = 1
TOKEN_BLOCK = 128
RUN_FILE, PLAN_FILE, CERTIFICATE_FILE = "run.json", "plan.json", "certificate.json"
COMMITS, FAILED, DATA, COLUMNS, VIDEOS = "commits", "failed", "data.zarr", "columns.zarr", "videos"
FRAMES = "frames"
CODECS = ("zstd", "fast", "none")


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

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "StoredStream":
        """Read back what `to_json` wrote."""
        return cls(**{**values, "views": tuple(values["views"])})

    def to_json(self) -> dict[str, Any]:
        """As stored in `run.json`."""
        return {**asdict(self), "views": list(self.views)}

    @property
    def stream(self) -> Stream:
        """The stream without its storage."""
        return Stream(self.name, self.layers, self.width, self.iterations)

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


def create_arrays(
    store: Store, streams: list[StoredStream], episodes: int, steps: int, with_tokens: bool, codec: str
) -> None:
    """Create every array at its final size; afterwards only chunks are written.

    Pooled rows: float32 (episode, step, [iteration,] layer, view, feature), one chunk per episode, NaN where
    nothing was captured. Tokens: uint16, one shard per episode, inner chunks of one layer x 128 tokens.
    """
    root = zarr.open_group(store, mode="w-", zarr_format=3)
    for stream in streams:
        group = root.create_group(stream.name)
        pooled = (*stream.lead, len(stream.views), stream.width)
        group.create_array(
            "pooled",
            shape=(episodes, steps, *pooled),
            chunks=(1, steps, *pooled),
            dtype="float32",
            fill_value=np.nan,
            compressors=codecs(codec, typesize=4),
            dimension_names=("episode", "step", *stream.dimensions, "view", "feature"),
            attributes={"views": list(stream.views)},
            config={"write_empty_chunks": True},
        )
        if with_tokens:
            tokens = (*stream.lead, stream.stored_tokens, stream.width)
            group.create_array(
                "tokens",
                shape=(episodes, steps, *tokens),
                shards=(1, steps, *tokens),
                chunks=(1, 1, *(1 for _ in stream.lead), stream.token_block, stream.width),
                dtype="uint16",
                fill_value=0,
                compressors=codecs(codec, typesize=2),
                dimension_names=("episode", "step", *stream.dimensions, "token", "feature"),
                attributes={"probe_kit:dtype": "bfloat16", "tokens": stream.tokens},
                config={"write_empty_chunks": True},
            )


def codecs(name: str, typesize: int) -> list[BytesBytesCodec]:
    """blosc with its block size set (its own choice at level 1 loses most of the gain), then a checksum."""
    if name == "none":
        return [Crc32cCodec()]
    fast = name == "fast"
    blosc = BloscCodec(
        typesize=typesize,
        cname="lz4" if fast else "zstd",
        clevel=1,
        shuffle="bitshuffle" if fast else "shuffle",
        blocksize=524288,
    )
    return [blosc, Crc32cCodec()]


def open_array(location: "Location", group: str, name: str) -> "zarr.Array[Any]":
    """Open one array for reading; a missing chunk is an error, never a fill value."""
    store = location.store(group, read_only=True)
    return zarr.open_array(store, path=name, mode="r", config={"read_missing_chunks": False})


def decode_bfloat16(bits: NDArray[np.uint16]) -> NDArray[np.float32]:
    """uint16 bit patterns of bfloat16 to float32, exactly."""
    return (bits.astype(np.uint32) << 16).view(np.float32)
