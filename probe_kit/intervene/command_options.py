"""Options of `probe-kit intervene`. What they mean to a kind is in the kind's entry."""

from functools import partial
from typing import Annotated

import typer

from probe_kit._terminal.console import split
from probe_kit._terminal.options import LISTED, Names, choices, further_option, one_of
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.interventions import Readout
from probe_kit.intervene.kinds.registry import KINDS

_inside_option = partial(typer.Option, rich_help_panel="Inside the network")


class Numbers(tuple[float, ...]):
    """Comma-separated numbers."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: "str | Numbers") -> "Numbers":
        """The numbers of `text`; a default that is no text is returned as it is. Raises UsageError."""
        if not isinstance(text, str):
            return text
        try:
            return cls(map(float, split(text) or ()))
        except ValueError:
            raise UsageError(f"--coefficients is {text!r}; expected numbers such as 1,2,4") from None


KindName = Annotated[
    str,
    typer.Option("--kind", parser=one_of(KINDS), metavar=choices(KINDS), help="Kind of intervention; see below."),
]
Checkpoint = Annotated[
    str | None,
    typer.Option(
        "--checkpoint", help="Checkpoint folder or Hugging Face id, OWNER/NAME[@REVISION]. Default: the run's."
    ),
]
Sites = Annotated[
    Names | None,
    _inside_option(
        "--sites",
        **LISTED,
        help="Sites, comma-separated: backbone.*, backbone.02, expert.03@0-4, backbone.02.heads.* or kv.*.",
    ),
]
Roles = Annotated[
    Names | None,
    _inside_option(
        "--roles",
        **LISTED,
        help="Token roles, comma-separated: all, image, image.left, image.right, language, state, action.",
    ),
]
Direction = Annotated[
    str | None,
    _inside_option(
        "--direction",
        help="Direction or subspace: none, mean-difference, probe, mean-difference:K, leace, inlp:K.",
    ),
]
Controls = Annotated[
    int | None, _inside_option("--controls", help="Number of matched random directions.", min=0, max=100)
]
Coefficients = Annotated[
    Numbers | None,
    _inside_option(
        "--coefficients",
        parser=Numbers.parse,
        metavar="1,2,…",
        help="Coefficients, comma-separated, in half class-mean differences.",
    ),
]
TargetSide = Annotated[
    str | None, _inside_option("--target-side", help="Target side: wrong, correct, left or right.")
]
ReadoutName = Annotated[
    Readout,
    further_option(
        "--readout",
        help="first-chunk: measure the first inference. per-step: measure every inference along the unedited "
        "episode (teacher-forced), for policies with one action per inference.",
    ),
]
WeightsSeed = Annotated[
    int | None, further_option("--weights-seed", help="Seed of the untrained weights. Default: that of the run.")
]
SceneFiles = Annotated[
    list[str] | None,
    further_option(
        "--scene-file",
        metavar="NAME=FILE",
        help="File of the scene, if the run had one and it was moved: background=FILE or arm_urdf=FILE. Repeat "
        "for several.",
    ),
]
