"""The files of a run: their names, and the layout of a stream. Only this package uses them directly.

RUN/
  run.json           the root: settings, streams, hashes of all metadata, and its own, see `root`
  label.json         what tables call the run; may be changed, see `root`
  left-out.json      only in a copy without activations: what it left out, see `root`
  plan/<n>.json      the episodes in order, each with its item's content hash; a further record when the run grows
  commits/<n>.json   one per finished episode, written last: hashes of its objects, and its own
  times/<n>.json     seconds that an episode took, which no other hash covers, see `commits`
  failed/<n>.json    why an episode was given up; removed when it is tried again
  certificate.json   what was really loaded, and what was checked
  certificates/      the same of every further process that played
  provenance/        versions and machine of every process that played
  data.zarr/         <stream>/pooled; with --tokens all <stream>/tokens; with --later-views mean <stream>/later
                     of all sources but the scene also inputs/<kind>
  columns.zarr/      the pooled rows again, by site and view; derived, see `columns`
  sealed/<stamp>.json  hashes of the columns, and of which commits they were made
  probes/            results of `probe-kit train`
  interventions/     results of `probe-kit intervene`
  diagnoses/         results of `probe-kit diagnose`
  videos/            GIFs, if asked for
  frames/<n>.webp    first and last frame of an episode, or all of them, see `thumbnails`

Every object is bound to the root by hashes, see `records`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

from probe_kit.hooks.contract.sites import QUANTITIES, Part, Site, Stream

METADATA = "zarr.json"
"""The name of the metadata of a group or array in Zarr v3."""
GROUP_FILE = "data.zarr/zarr.json"
"""The metadata of the group of all arrays, which never changes."""
ROOM = 1_000_000
"""The episodes an array has room for; one chunk holds one episode, and no chunk exists before its episode."""
SCHEMA_VERSION = 6
"""The only schema version that is written and read."""
TOKEN_BLOCK = 128
"""The tokens per inner chunk, the least that one role of one layer is read by; stored tokens are padded to it."""
RUN_FILE, PLANS, CERTIFICATE_FILE = "run.json", "plan", "certificate.json"
LABEL_FILE, TIMES, LEFT_OUT_FILE = "label.json", "times", "left-out.json"
COMMITS, FAILED, DATA, COLUMNS, VIDEOS = "commits", "failed", "data.zarr", "columns.zarr", "videos"
FRAMES, CERTIFICATES, SEALED, PROBES, PROVENANCE = "frames", "certificates", "sealed", "probes", "provenance"
PROBE_DIRECTIONS = "directions.npz"
"""The file of a probe result with the weights: nine tenths of its bytes."""
INTERVENTIONS, DIAGNOSES = "interventions", "diagnoses"
TRAJECTORY, TRAJECTORY_AXES = "trajectory", 3
"""The array of what happened in episodes, beside those of streams; an episode that did not act has no object."""
FIRST_FRAME = "first_frame_sha256"
"""The column of episodes that shows whether runs began with the same pictures."""
TRUTHS = "truth"
"""An entry of the names of inputs: the columns that are truth values."""
CLASSES = "classes."
"""A prefix of a column's name among the names of inputs: the entry has the texts that the column indexes."""
INPUTS = "inputs"
"""The group of arrays that hold what a source without a scene showed: state, actions, small pictures."""
ILLUSTRATIONS = (FRAMES, VIDEOS)
"""Pictures for people, which a run can do without."""
Codec = Literal["zstd", "fast", "none"]
CODECS: tuple[Codec, ...] = get_args(Codec)
Tokens = Literal["pooled", "all"]
AskTokens = Literal["none", "pooled", "all"]
"""The stored part of the streams: nothing, the pooled views, or these and every token."""
LaterViews = Literal["all", "mean"]
"""The pooled views that are stored of the inferences after the first."""
MEAN_VIEW, LATER = "mean", "later"
"""The view that later inferences keep with `mean`, and the array that holds it."""
VectorKind = Literal["pooled", "later"]
ArrayKind = Literal["pooled", "later", "tokens"]
"""The arrays of a stream: those with a vector per view, and all."""
VideoChoice = Literal["none", "first", "all"]
"""The episodes of which a GIF is stored."""
FrameChoice = Literal["ends", "all", "none"]
"""The frames of an episode of which a small copy is stored."""
FRAME_COLUMNS = 8
"""The frames in a row of the picture that holds them."""
MOST_FRAMES = FRAME_COLUMNS * 68
"""The most frames in one picture: a WebP has at most 16,383 pixels a side, and a frame of a film is 240 high."""
ExportFormat = Literal["h5", "safetensors", "lerobot", "parquet", "sae", "directions"]
DIRECTION_FILES: dict[ExportFormat, str] = {"directions": "directions.safetensors"}
"""The default file names of exports whose ending is not the name of their format."""
SaeDtype = Literal["bfloat16", "float16"]
"""The numbers in a memory map to train sparse autoencoders on."""
ONCE, AT_END = "success_once", "success_at_end"
"""The columns of episodes with whether `success` was true after any action, and after the last one."""
LIMIT, START = "limit", "start_blake2b"
"""Columns of episodes of environments.

They hold the number of actions after which the benchmark ends an episode, where it declares one, and the hash of
the first observation.
"""
CAPTURE_ONLY = "capture_only"
"""The outcome of an episode whose model was captured and did not act: there is no success rate."""
CONDITION = "condition"
"""The column of served episodes with the name of the edits that each was played with."""
CONDITIONS = "conditions"
"""The entry of a certificate with what the last edit of each condition did."""
POSSIBLE_STARTS = "possible_starts"
"""The column of served episodes with the number of observations that may begin another, unnamed episode."""
UNEDITED = "none"
"""The condition without edits, with which others are compared."""
DATASET = "dataset"
"""The part of a run's settings that names the recordings, pictures or other stored observations it shows.

Runs of the scene have `suite` and `scene` instead.
"""

ENVIRONMENT = "environment"
"""The part of a run's settings that says in which environment of the user's own it was played."""
RECORDED_EPISODES = "recorded_episodes"
"""The entry of `recording` in the settings with the number of episodes of the run's data set."""
UNITS = "units"
"""The entry of a selection that says which numbers do not fit the statistics of the checkpoint, by heading."""
OTHER_ACTIONS = "other_actions"
"""The entry of a selection of recordings that says why predicted and recorded actions are not compared.

It is None where they are compared.
"""


def source_settings_of(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the settings of recordings or environment, with shapes and names of `inputs`; empty for scenes."""
    described: Mapping[str, Any] = settings.get(DATASET) or settings.get(ENVIRONMENT) or {}
    return described


def check_distinct(names: Sequence[str]) -> Sequence[str]:
    """Return the names. Raises ValueError if one stands twice."""
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"{', '.join(twice)} stands twice; expected each name once")
    return names


_Count = Annotated[int, Field(gt=0, strict=True)]
_Flag = Annotated[bool, Field(strict=True)]
_Names = Annotated[tuple[str, ...], AfterValidator(check_distinct)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class StoredStream:
    """The storage of one stream, also as `run.json` holds it.

    Attributes:
        tokens: The sequence length T as the model packs it.
        views: The pooled views V, in storage order.
    """

    name: str
    layers: _Count
    width: _Count
    iterations: _Count | None
    tokens: _Count
    views: _Names
    part: Part | None = None
    label: str = ""
    quantities: _Names = QUANTITIES
    probed: _Flag = True
    sums: _Flag = True

    @classmethod
    def of(cls, stream: Stream, tokens: int, views: tuple[str, ...]) -> "StoredStream":
        """Return the storage of a declared stream."""
        declared = {part.name: getattr(stream, part.name) for part in fields(Stream) if part.init}
        declared.pop("heads")  # which is not stored
        return cls(**declared, tokens=tokens, views=views)

    @property
    def stream(self) -> Stream:
        """The stream without its storage."""
        parts = dict(vars(self))
        del parts["tokens"], parts["views"]
        return Stream(**parts)

    @property
    def lead(self) -> tuple[int, ...]:
        """The axes before the token or view axis: (L,) or (I, L)."""
        return (self.layers,) if self.iterations is None else (self.iterations, self.layers)

    @property
    def dimensions(self) -> tuple[str, ...]:
        """The names of the axes `lead`."""
        return ("layer",) if self.iterations is None else ("iteration", "layer")

    @property
    def token_block(self) -> int:
        """The tokens per inner chunk."""
        return min(TOKEN_BLOCK, self.tokens)

    @property
    def stored_tokens(self) -> int:
        """The sequence length T rounded up to whole blocks; tokens beyond T are zeros."""
        return -(-self.tokens // self.token_block) * self.token_block

    def at(self, site: Site) -> tuple[int, ...]:
        """Return the index of `site` in the lead axes."""
        return (site.layer,) if site.iteration is None else (site.iteration, site.layer)

    def arrays(self, with_tokens: bool, later_views: str = "all") -> dict[str, int]:
        """Return the number of axes of every array in `data.zarr` that holds this stream."""
        axes = 2 + len(self.lead) + 2  # episode and call before, token or view and feature behind
        kinds = {"pooled": axes, **({"tokens": axes} if with_tokens else {})}
        later = {LATER: axes - 1} if later_views == MEAN_VIEW else {}
        return {f"{self.name}/{kind}": count for kind, count in (kinds | later).items()}

    def raw_bytes(self, with_tokens: bool, calls: int = 1, later_views: LaterViews = "all") -> int:
        """Return the uncompressed bytes of the captured inferences of an episode."""
        cells = int(np.prod(self.lead)) * self.width
        per_call = cells * len(self.views) * 4 + (cells * self.tokens * 2 if with_tokens else 0)
        return per_call * calls if later_views == "all" else per_call + cells * 2 * (calls - 1)
