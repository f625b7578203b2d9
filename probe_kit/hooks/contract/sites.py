"""Sites: the names under which activations are captured, stored, probed and plotted; roles and views. No torch."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

from probe_kit.errors import UnknownSiteError, UsageError

Part = Literal["backbone", "action", "vision", "bridge"]
PARTS: tuple[Part, ...] = get_args(Part)
QUANTITIES = ("residual", "attention", "mlp", "final_norm")
"""The quantities that the streams of today's families have; a family may declare others."""
KV = ("keys", "values")
"""Quantities of the stream `kv`, per block and token: all heads side by side, as attention reads them.

Keys are those after rotation.
"""
KV_STREAM = "kv"
HEADS = "heads"
"""The values that every attention head of a block read, side by side: the input of the block's output projection.

(B, T, heads times size of a head), of streams that declare `Stream.heads`. No run stores it.
"""

_PATTERN = re.compile(
    r"(?P<stream>[a-z][a-z_0-9]*)\.(?P<layer>\d{2,18})\.(?P<quantity>[a-z_]+)(@(?P<iteration>\d{1,18}))?"
)
# Streams whose name says their part, so that an adapter need not.
_KNOWN_PARTS: dict[str, Part] = {
    "backbone": "backbone",
    "expert": "action",
    "action": "action",
    "answer": "action",
    "vision": "vision",
    "vision_fused": "vision",
}
_LABELS = {"expert": "action expert", "action": "action tokens", "answer": "answer tokens"}


@dataclass(frozen=True, order=True)
class Site:
    """One named tensor: `backbone.07.residual`, `expert.03.residual@4`.

    Attributes:
        stream: A stream of the model, such as `backbone` (VLM) or `expert` (action part); see `Stream.part`.
        layer: The block, counted from 0; for `residual` the block that the stream enters.
        quantity: `residual` is the stream *entering* block `layer`; 0 is the embeddings, the last one enters the
            final norm. `attention` and `mlp` are what block `layer` adds to it, as it is added: behind a norm,
            gate or scale, where the family has one. `final_norm` is its normed end. `heads` is what the block's
            attention heads read, see `HEADS`. A family may declare further quantities.
        iteration: Flow-matching step, counted from 0 (pure noise); for action tokens, the token; for `vision` with
            several cameras, the camera. None where the stream runs once.
    """

    stream: str
    layer: int
    quantity: str = "residual"
    iteration: int | None = None

    def __str__(self) -> str:
        suffix = "" if self.iteration is None else f"@{self.iteration}"
        return f"{self.stream}.{self.layer:02d}.{self.quantity}{suffix}"

    @classmethod
    def parse(cls, name: str) -> "Site":
        """The site called `name`.

        Raises:
            UnknownSiteError: If the name has another form.
        """
        match = _PATTERN.fullmatch(name)
        if match is None:
            raise UnknownSiteError(
                f"{name!r} is not a site; expected <stream>.<layer>.<quantity>[@<iteration>], "
                "such as backbone.07.residual or expert.03.residual@4"
            )
        iteration = match["iteration"]
        return cls(
            match["stream"], int(match["layer"]), match["quantity"], None if iteration is None else int(iteration)
        )


@dataclass(frozen=True)
class Stream:
    """The shape and meaning of one residual stream.

    Attributes:
        layers: One more than the number of blocks, which is the number of residual sites where there are any.
        width: Features per token.
        iterations: Flow-matching steps or action tokens per inference, or None where the stream runs once.
        part: The part of the model it belongs to: `backbone` (VLM), `action`, `vision`, or `bridge` between them.
            The action is made in `action`: an expert, or the positions that choose action tokens. None takes the
            part that the name tells.
        label: The name that people read; "" takes the name in plain words.
        quantities: The quantities that can be captured of it: with `residual`, but for the stream `kv`.
        probed: Whether peaks, retention and default probes use it; False for the unconditional half of guidance.
        sums: Whether residual + attention + mlp make the next residual; False where something else enters between
            blocks, such as DeepStack's pictures.
        heads: Attention heads of every block, where the family taps the quantity `heads`; 0 where it does not.

    Raises:
        UsageError: For an unknown part, or none where the name does not tell it.
    """

    name: str
    layers: int
    width: int
    iterations: int | None = None
    part: Part | None = None
    label: str = ""
    quantities: tuple[str, ...] = QUANTITIES
    probed: bool = True
    sums: bool = True
    heads: int = field(default=0, compare=False)  # stored and declared streams do not say it

    def shape_json(self) -> dict[str, int]:
        """Return layers, width, and iterations where the stream runs several times, as plain values."""
        iterations = {} if self.iterations is None else {"iterations": self.iterations}
        return {"layers": self.layers, "width": self.width, **iterations}

    def __post_init__(self) -> None:
        part = self.part or _KNOWN_PARTS.get(self.name)
        if part not in PARTS:
            raise UsageError(
                f"stream {self.name!r} declares part {self.part!r}; expected one of {', '.join(PARTS)}. Say it in "
                f"the adapter: Stream({self.name!r}, …, part='action')"
            )
        # The way to fill in a field of a frozen dataclass.
        object.__setattr__(self, "part", part)
        object.__setattr__(self, "label", self.label or label_of(self.name))

    @property
    def captured(self) -> tuple[str, ...]:
        """Every quantity that can be captured: `quantities`, and `heads` where heads are declared."""
        return (*self.quantities, HEADS) if self.heads else self.quantities

    def sites(self, quantity: str = "residual") -> list[Site]:
        """All sites of one quantity, ordered by iteration, then layer.

        `final_norm` exists once, behind the last block; `residual` per layer; every other quantity per block.

        Raises:
            UnknownSiteError: For a quantity that this stream does not have.
        """
        if quantity not in self.captured:
            raise UnknownSiteError(
                f"the stream {self.name} has no quantity {quantity!r}; it has {', '.join(self.captured)}"
            )
        return [
            Site(self.name, layer, quantity, step) for step in self._steps for layer in self._layers_of(quantity)
        ]

    def holds(self, site: Site) -> bool:
        """Whether `site` is one of its `sites`; none are listed for it, as it is asked at every edit."""
        has_quantity = site.stream == self.name and site.quantity in self.captured
        return has_quantity and site.iteration in self._steps and site.layer in self._layers_of(site.quantity)

    @property
    def _steps(self) -> "Sequence[int | None]":
        return (None,) if self.iterations is None else range(self.iterations)

    def _layers_of(self, quantity: str) -> range:
        if quantity == "residual":
            return range(self.layers)
        return range(self.layers - 1, self.layers) if quantity == "final_norm" else range(self.layers - 1)


def kv_stream(blocks: int, width: int) -> Stream:
    """The stream `kv` of a backbone of so many blocks; `width` is heads times size of a head."""
    return Stream(
        KV_STREAM, blocks + 1, width, part="bridge", label="keys and values of the prompt", quantities=KV
    )


def part_of(stream: str) -> Part:
    """The part of a stream known by name only, as in curves of controls; `backbone` if the name tells nothing."""
    return _KNOWN_PARTS.get(stream, "backbone")


def label_of(stream: str) -> str:
    """The label of a stream of which only the name is left."""
    return _LABELS.get(stream, stream.replace("_", " "))


def first_of(part: Part, streams: Iterable[Stream]) -> str | None:
    """The first probed stream of `part` by name, the one peaks and retention are about; None if there is none."""
    return next((stream.name for stream in streams if stream.part == part and stream.probed), None)


# -- roles and views ------------------------------------------------------------------------------------------

PADDING = "padding"
CAMERA = "primary"
"""The camera of families whose models know one."""
IMAGE_ROLE = f"image.{CAMERA}"


def plays(role: str, group: str) -> bool:
    """Whether a token of `role` belongs to `group`: `image.wrist` belongs to `image.wrist` and to `image`."""
    return role == group or role.startswith(f"{group}.")


def view_names(roles: Sequence[str]) -> tuple[str, ...]:
    """The pooled views of a stream whose tokens play `roles`: mean, last, and one mean per role.

    With several cameras also `mean:image` over all of them; with one, `resolve_view` finds it under that name.
    """
    images = [role for role in roles if plays(role, "image")]
    content_roles = [role for role in roles if role not in (PADDING, "special")]
    return (
        "mean",
        "last",
        *(f"mean:{role}" for role in content_roles),
        *(["mean:image"] if len(images) > 1 else []),
    )


def resolve_view(view: str, stored: Sequence[str]) -> str:
    """The stored view that `view` names: itself, or `mean:image.<camera>` for `mean:image` of the only camera."""
    if view in stored or not view.startswith("mean:"):
        return view
    parts = [name for name in stored if name.startswith(f"{view}.")]
    return parts[0] if len(parts) == 1 else view


def role_of_view(view: str) -> str | None:
    """Return the role whose tokens a view averages, `all` for `mean`; None for another view."""
    kind, _, role = view.partition(":")
    return (role or "all") if kind == "mean" else None
