"""Options of `probe-kit intervene`. What they mean to a kind is in the kind's entry."""

from typing import Annotated

import typer

from probe_kit._terminal.console import split
from probe_kit._terminal.options import Names, choices, one_of
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.interventions import Readout
from probe_kit.intervene.kinds.registry import KINDS

INSIDE = "Inside the network (their meaning for each kind is below)"


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
Sites = Annotated[
    Names | None,
    typer.Option(
        "--sites",
        parser=Names.parse,
        metavar="A,B,…",
        help="Sites, comma-separated, such as backbone.*, backbone.02, expert.03@0-4 or kv.*.",
        rich_help_panel=INSIDE,
    ),
]
Roles = Annotated[
    Names | None,
    typer.Option(
        "--roles",
        parser=Names.parse,
        metavar="A,B,…",
        help="Token roles, comma-separated: all, image, image.left, image.right, language, state, action.",
        rich_help_panel=INSIDE,
    ),
]
Direction = Annotated[
    str | None,
    typer.Option(
        "--direction",
        help="Direction or subspace: none, mean-difference, probe, mean-difference:K, leace, inlp:K.",
        rich_help_panel=INSIDE,
    ),
]
Controls = Annotated[
    int | None,
    typer.Option(
        "--controls", help="Number of matched random directions.", min=0, max=100, rich_help_panel=INSIDE
    ),
]
Coefficients = Annotated[
    Numbers | None,
    typer.Option(
        "--coefficients",
        parser=Numbers.parse,
        metavar="1,2,…",
        help="Coefficients, comma-separated, in half class-mean differences.",
        rich_help_panel=INSIDE,
    ),
]
TargetSide = Annotated[
    str | None,
    typer.Option("--target-side", help="Target side: wrong, correct, left or right.", rich_help_panel=INSIDE),
]
ReadoutName = Annotated[
    Readout,
    typer.Option(
        "--readout",
        help="first-chunk: measure the first inference. per-step: measure every inference along the unedited "
        "episode (teacher-forced), for policies with one action per inference.",
    ),
]
SceneFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--scene-file",
        metavar="NAME=FILE",
        help="File of the scene, if the run had one: background=FILE or arm_urdf=FILE. Repeat for several.",
    ),
]
