"""Options of `probe-kit extract` and `probe-kit ask` that are no settings: where and whether a run starts."""

from pathlib import Path
from typing import Annotated

import typer

from probe_kit._terminal.options import Names, read_size
from probe_kit.errors import UsageError
from probe_kit.extract.parts import stored_option


class Sizes(tuple[tuple[int, int], ...]):
    """Comma-separated sizes of pictures, (width, height) in pixels each."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: "str | Sizes") -> "Sizes":
        """The sizes of `text`, each WIDTHxHEIGHT; a default that is no text is returned as it is."""
        if not isinstance(text, str):
            return text
        return cls(map(read_size, several("--picture-size", text)))

    def __str__(self) -> str:
        """Return the sizes as they are typed."""
        return ",".join(f"{width}x{height}" for width, height in self)


def several(option: str, text: str | Names) -> Names:
    """The parts of a comma-separated option. Raises UsageError for none."""
    parts = Names.parse(text)
    if not parts:
        raise UsageError(f"{option} is empty; name at least one")
    return parts


def _prompts(text: str | Names) -> Names:
    return several("--prompt", text)


OutFolder = Annotated[
    str | None,
    typer.Option(
        "--out", metavar="FOLDER", help="Folder or s3://BUCKET/PREFIX/RUN. Default: runs/<model>-<settings hash>."
    ),
]
AskOutFolder = Annotated[
    str | None,
    typer.Option(
        "--out",
        metavar="FOLDER",
        help="Folder or URL that holds one run per prompt and size. Default: a folder per run below runs/.",
    ),
]
Prompts = Annotated[
    Names | None,
    typer.Option(
        "--prompt",
        parser=_prompts,
        metavar="A,B,…",
        show_default="p1,p2,seen; instruction where there are no objects",
        help="Prompts, comma-separated: seen, p1, p2 (from the paper), instruction (the words of the policies) "
        "or text files. A file contains {object}, and {A} and {B} for the sides.",
    ),
]
PictureSizes = Annotated[
    Sizes | None,
    typer.Option(
        "--picture-size",
        parser=Sizes.parse,
        metavar="WxH,…",
        show_default="224x224",
        help="Picture sizes in pixels, comma-separated. The paper uses 224x224 and 560x480.",
    ),
]

Large = Annotated[
    bool, stored_option("--yes", help="Begin a run that would take more than 64 GB before compression.")
]

ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="Settings of --print-config, or a run whose settings are repeated. Typed options take precedence.",
    ),
]
PrintConfig = Annotated[bool, typer.Option("--print-config", help="Print the settings for --config, and stop.")]
