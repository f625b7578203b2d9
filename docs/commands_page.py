"""An mkdocs hook: puts the options of every command, as Typer knows them, into the page `commands.md`.

The line `<!-- every command -->` becomes a heading per panel of `probe-kit --help`. Below it stand the help of
every command and a table of its arguments and options, and below `intervene` a table of the registered kinds.
"""

import re
from functools import cache
from typing import Any

import typer

PAGE = "commands.md"
_PLACE = "<!-- every command -->"
_OF_FILE = re.compile(r"<!-- of the file alone -->\n.*?<!-- end of it -->\n+", re.DOTALL)
"""What a reader of the file needs to know, and the built page does not say."""


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Called by mkdocs for every page."""
    if page.file.src_uri != PAGE:
        return markdown
    return _OF_FILE.sub("", markdown).replace(_PLACE, commands_markdown())


def commands_markdown() -> str:
    """Every command that does something, such as `suite build`, under the panel of `probe-kit --help`."""
    from probe_kit.cli import PANELS

    sections = []
    paths = [path for path, command in _walk(_root(), "") if not hasattr(command, "commands")]
    for panel, names in PANELS.items():
        sections.append(f"## {panel}")
        for path in (path for name in names for path in paths if path.split()[0] == name):
            sections += [f"### probe-kit {path}", command_markdown(path)]
            if path == "intervene":
                sections.append(kinds_markdown())
    return "\n\n".join(sections)


def command_markdown(path: str) -> str:
    """Help text and options of one command."""
    command = _root()
    for name in path.split():
        command = command.commands[name]
    rows = [row for parameter in command.params if (row := _row(parameter))]
    table = ["| argument or option | default | meaning |", "|---|---|---|", *rows] if rows else []
    return "\n".join([_text(command.help), "", *table])


def kinds_markdown() -> str:
    """What every kind of intervention does, and what the options mean to it."""
    from probe_kit.intervene.kinds import every_kind

    rows = []
    for kind in every_kind():
        rows.append(f"| `{kind.kind}` | | {_text(kind.summary)} |")
        rows += [
            f"| | `--{name.replace('_', '-')}` | {_text(meaning)} |" for name, meaning in kind.options.items()
        ]
    return "\n".join(["| kind | option | meaning |", "|---|---|---|", *rows])


@cache
def _root() -> Any:
    from probe_kit.cli import app

    return typer.main.get_command(app)


def _walk(group: Any, prefix: str) -> list[tuple[str, Any]]:
    found = []
    for name, command in group.commands.items():
        path = f"{prefix} {name}".strip()
        found.append((path, command))
        if hasattr(command, "commands"):
            found += _walk(command, path)
    return found


def _row(parameter: Any) -> str:
    names = ", ".join(f"`{name}`" for name in _names(parameter))
    if "--help" in names:
        return ""
    default = "required" if parameter.required else _default(parameter)
    return f"| {names} | {default} | {_text(parameter.help)} |"


def _names(parameter: Any) -> list[str]:
    if parameter.param_type_name == "argument":
        return [parameter.name.upper()]
    return [
        option if parameter.is_flag else f"{option} …" for option in (*parameter.opts, *parameter.secondary_opts)
    ]


def _default(parameter: Any) -> str:
    default = parameter.default
    return "" if default is None or default is False or callable(default) else f"`{default}`"


def _text(text: str | None) -> str:
    """One line per paragraph; a bar would end the cell of a table."""
    return (text or "").strip().replace("\b\n", "").replace("|", "\\|")
