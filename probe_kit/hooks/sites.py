"""Sites: the names under which activations are captured, stored, probed and plotted."""

import re
from dataclasses import dataclass

from probe_kit.errors import UnknownSiteError

_PATTERN = re.compile(r"(?P<stream>[a-z_]+)\.(?P<layer>\d{2,})\.(?P<quantity>[a-z_]+)(@(?P<iteration>\d+))?")


ACTION_STREAMS = ("expert", "action")
"""Where the action is made: the expert or, in a policy without one, the positions that choose action tokens."""


@dataclass(frozen=True, order=True)
class Site:
    """One named tensor: `backbone.07.residual`, `expert.03.residual@4`.

    stream: `backbone` (VLM), `expert` (action part) or, in a policy without one, `action`; where a family offers
    it, `vision`.
    layer, quantity: `residual` is the stream *entering* block `layer`; 0 is the embeddings, the last one enters
    the final norm. `attention` and `mlp` are what block `layer` adds to it. `final_norm` is its normed end.
    iteration: flow-matching step, counted from 0 (pure noise); for `action`, the action token; the camera, for
    `vision` with several of them; None where the stream runs once.
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
        """The site called `name`. Raises UnknownSiteError if the name has another form."""
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
    """The shape of one residual stream.

    layers: number of residual sites, one more than the number of blocks.
    width: features per token.
    iterations: flow-matching steps or action tokens per inference, or None where the stream runs once.
    """

    name: str
    layers: int
    width: int
    iterations: int | None = None

    def sites(self, quantity: str = "residual") -> list[Site]:
        """All sites of one quantity, ordered by iteration, then layer.

        `attention` and `mlp` exist per block, `final_norm` once, behind the last block.
        Raises UnknownSiteError for another quantity.
        """
        layers = {
            "residual": range(self.layers),
            "attention": range(self.layers - 1),
            "mlp": range(self.layers - 1),
            "final_norm": range(self.layers - 1, self.layers),
        }
        if quantity not in layers:
            raise UnknownSiteError(f"no quantity {quantity!r}; expected one of {', '.join(layers)}")
        steps: list[int | None] = [None] if self.iterations is None else list(range(self.iterations))
        return [Site(self.name, layer, quantity, step) for step in steps for layer in layers[quantity]]
