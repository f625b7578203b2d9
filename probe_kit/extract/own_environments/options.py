"""Options of `probe-kit extract` that choose an environment of the user's own."""

from functools import partial
from typing import Annotated

import typer

_option = partial(typer.Option, rich_help_panel="Own environments")

Env = Annotated[
    str | None,
    _option(
        "--env",
        metavar="MODULE:CLASS",
        help="Play an environment of your own in place of a suite, or lerobot:TYPE such as lerobot:libero. "
        "`probe-kit check-environment` checks one.",
    ),
]
EnvOptions = Annotated[
    list[str] | None,
    _option("--env-option", metavar="KEY=VALUE", help="Argument of the environment; repeatable."),
]
