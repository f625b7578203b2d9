"""Options that several commands share, each declared once as an annotated type.

`def command(partial: Partial = False, device: Device = "auto")` gives a command the option with its help. Closed
vocabularies are `Literal` types of the library, whose values help lists and parsing checks. `some_of` and `one_of`
do the same for comma-separated values and for the names of a registry.
"""

from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Self

import typer

from probe_kit._terminal.console import split, whole_number
from probe_kit.errors import UsageError
from probe_kit.scene_names import SceneName

speed_option = partial(typer.Option, rich_help_panel="Speed and hardware")
"""A constructor of options in the panel of options that change no number."""
further_option = partial(typer.Option, rich_help_panel="Further settings")
"""A constructor of options that are seldom needed, in the panel of further settings."""
_weights_option = partial(typer.Option, rich_help_panel="Model weights")
_resuming_option = partial(typer.Option, rich_help_panel="Resuming")


class Names(tuple[str, ...]):
    """The parts of a comma-separated option in order, each once."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: str | Self) -> Self:
        """Return the parts of `text`; a default that is no text is returned as it is."""
        return cls(split(text) or ()) if isinstance(text, str) else text

    def __str__(self) -> str:
        """Return the names as they are typed."""
        return ",".join(self)


def read_categories(text: str | Names) -> Names:
    """Return categories by slug or title, in any case: `Living World` is `living-world`."""
    return Names("-".join(name.lower().split()) for name in Names.parse(text))


LISTED: Any = {"parser": Names.parse, "metavar": "A,B,…"}
"""The keywords of `typer.Option` for comma-separated names."""
NAMED: Any = LISTED | {"parser": read_categories}
"""The keywords of `typer.Option` for comma-separated categories."""


def check_no_others(typed: Mapping[str, object], what: str = "labels of your own") -> None:
    """Raise UsageError for an option that does not go with `what`, from whether each option was typed."""
    if wrong := [name for name, value in typed.items() if value]:
        raise UsageError(f"{wrong[0]} is not for {what}; leave it out")


def choices(names: Collection[object]) -> str:
    """Return the choices of an option as help shows them, such as `<one|two>`."""
    return f"<{'|'.join(map(str, names))}>"


def one_of(names: Collection[str]) -> Callable[[str], str]:
    """Return a parser for the names of a registry; others end the command with exit code 2 and the list."""

    def parse(text: str) -> str:
        return _check_choice(text, names)

    return parse


def some_of(names: Collection[str], none: str | None = None) -> Callable[[str | Names], Names]:
    """Return a parser for comma-separated `names`, which keeps a default that is `Names` as it is.

    The word `none` stands for the empty selection; without such a word an empty selection is refused.
    """

    def parse(text: str | Names) -> Names:
        if isinstance(text, Names):
            return text
        if text == none:
            return Names()
        parts = Names.parse(text)
        if not parts:
            raise typer.BadParameter(f"it is empty; expected some of {', '.join(names)}")
        return Names(_check_choice(part, names) for part in parts)

    return parse


def _check_choice(name: str, choices: Collection[str]) -> str:
    if name not in choices:
        raise typer.BadParameter(f"{name!r} is not one of {', '.join(map(repr, choices))}.")
    return name


def read_size(text: str) -> tuple[int, int]:
    """Return (width, height) in pixels from WIDTHxHEIGHT. Raises UsageError for another form."""
    width, height = map(whole_number, text.partition("x")[::2])
    if width is None or height is None:
        raise UsageError(f"picture size {text!r} is not WIDTHxHEIGHT, such as 224x224")
    return width, height


# -- what to read -----------------------------------------------------------------------------------------------

RunFolder = Annotated[str, typer.Argument(help="Run folder or URL.", metavar="RUN")]
Partial = Annotated[bool, further_option("--partial", help="Accept unfinished runs.")]
SuiteFolder = Annotated[
    Path | None, typer.Option("--suite", help="Suite folder. Default: the embedded suite.", metavar="FOLDER")
]
Categories = Annotated[
    Names | None,
    typer.Option("--categories", **NAMED, help="Question categories, comma-separated. Default: all."),
]
Items = Annotated[int | None, typer.Option("--items", help="Number of items per category. Default: all.")]
Wording = Annotated[
    str | None,
    further_option(
        "--wording", help="Wording to analyse in a run with several wordings. Default: the first of the run."
    ),
]
Scene = Annotated[
    SceneName | None, further_option("--scene", help="Scene preset. Default: that of the protocol or the model.")
]
Seed = Annotated[int, further_option("--seed", help="Random seed. The same seed gives the same result.")]

# -- model ------------------------------------------------------------------------------------------------------

ModelName = Annotated[str, typer.Option("--model", metavar="NAME", help="Model; `probe-kit models` lists them.")]
Checkpoint = Annotated[
    str | None,
    typer.Option(
        "--checkpoint",
        help="Checkpoint folder or Hugging Face id, OWNER/NAME[@REVISION]. "
        "Default: the family's released checkpoint.",
    ),
]
ModelOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--model-option",
        "-M",
        metavar="KEY=VALUE",
        help="Set an option of the model; `probe-kit models NAME` lists them. Repeat for several.",
    ),
]
RandomWeights = Annotated[bool, _weights_option("--random-weights", help="Use untrained weights, as a control.")]
WeightsSeed = Annotated[int, _weights_option("--weights-seed", help="Seed of the untrained weights.")]
Device = Annotated[
    str,
    typer.Option("--device", help="Device of the model: cpu, cuda, cuda:1, … auto: a GPU, else cpu."),
]

# -- speed ------------------------------------------------------------------------------------------------------

EnvWorkers = Annotated[
    int | None,
    speed_option("--env-workers", help="Number of simulation processes. Default: two per observation of a batch."),
]
Workers = Annotated[
    int,
    speed_option("--workers", help="Number of model processes, one per GPU. 0: the model runs in this process."),
]
RayAddress = Annotated[
    str | None,
    speed_option(
        "--ray", metavar="ADDRESS", help="Run on this Ray cluster. auto: use the local cluster, or start one."
    ),
]
InferenceLimit = Annotated[
    float | None,
    speed_option(
        "--inference-limit",
        help="Stop a worker if one call of the model takes longer than this, in seconds. Requires --workers "
        "or --ray.",
    ),
]

# -- planning and output ----------------------------------------------------------------------------------------

DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Print the plan and stop. Needs no weights, no internet and no GPU.")
]
AllowMixed = Annotated[
    bool,
    _resuming_option(
        "--allow-mixed", help="Resume a run that was started with other library versions or on another device."
    ),
]
Force = Annotated[bool, _resuming_option("--force", help="Start even if disk space seems insufficient.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
WholeTable = Annotated[bool, typer.Option("--details", help="Print every column, in several tables if need be.")]
