"""`probe-kit models`: the model families that `probe-kit extract --model` accepts."""

from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from probe_kit._terminal.console import marked, out, print_json, print_text
from probe_kit._terminal.options import AsJson, check_no_others
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.card import EMBEDDED

if TYPE_CHECKING:
    from probe_kit.hooks.family import Family


def models(
    name: Annotated[str | None, typer.Argument(help="Model to show. Default: all.")] = None,
    run: Annotated[str | None, typer.Option(metavar="RUN", help="Show the certificate of this run.")] = None,
    words: Annotated[
        bool,
        typer.Option(
            "--words", help="List the words that the embedded models know, one per line. Others read any text."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """List the models, one per line. With NAME: its checkpoint, streams, options and missing requirements.

    A third party's model is imported only when it is named.
    """
    if words:
        _print_words(name, run, as_json)
        return
    if run is not None:
        from probe_kit.runs import open_run

        print_json(open_run(run, allow_partial=True).certificate)
        return
    rows = _model_rows(name)
    if as_json:
        print_json(rows)
        return
    if name is None:
        out.print(_listed(rows))
        return
    for row in rows:
        out.print(marked("[bold]{}[/]  {}", row["model"], row["description"]))
        for key in ("checkpoint", "streams", "embodiment", "scene", "does", "ready", "weights", "notes"):
            if row[key]:
                out.print(marked("  [dim]{}[/] {}", f"{key:10}", row[key]), soft_wrap=True)
        for protocol, settings in row["protocols"].items():
            line = ", ".join(f"{name} {value}" for name, value in settings.items())
            out.print(marked("  [dim]protocol  [/] {}: {}", protocol, line), soft_wrap=True)
        if (supported := row["interventions"]) is not None:
            readout = (
                ""
                if supported["readout"] == "first-chunk"
                else "; one action per inference, which says little alone"
            )
            supported_options = "; ".join(
                f"{option} {', '.join(values)}" for option, values in supported["asked_as"].items()
            )
            out.print(marked("  [dim]intervene [/] {}", f"{supported_options}{readout}"), soft_wrap=True)
        for option in row["options"]:
            default = f" Default {option['default']}." if option["default"] else ""
            line = f"-M {option['name']}={option['kind'].upper()}  {option['help']}{default}"
            out.print(marked("  [dim]option    [/] {}", line), soft_wrap=True)


def _print_words(name: str | None, run: str | None, as_json: bool) -> None:
    from probe_kit.extract.parts import SCRIPTED
    from probe_kit.hooks.registry import find_family, own_families

    check_no_others({"--run": run is not None}, "--words")
    families = list(own_families().values()) if name is None else [find_family(name, tuple(SCRIPTED))]
    if not any(family.vocabulary for family in families):
        raise UsageError(f"{name} reads any text; --words lists those of embedded models. Leave --words out")
    listed = sorted({word for family in families for word in family.known_words()})
    if as_json:
        print_json(listed)
    else:
        print_text("\n".join(listed))


def _listed(rows: list[dict[str, Any]]) -> Text:
    """A line per model, its description cut behind a word where the console ends."""
    lines = [(row["model"], row["does"], _in_a_word(row["ready"]), row["description"]) for row in rows]
    lines = [("model", "does", "ready", "what it is"), *lines]
    widths = [max(len(line[column]) for line in lines) for column in range(3)]
    joined = [
        "  ".join([*(f"{cell:{width}}" for cell, width in zip(line, widths, strict=False)), line[3]])
        for line in lines
    ]
    cut = [line if len(line) <= out.width else f"{line[: out.width - 1].rpartition(' ')[0]} …" for line in joined]
    return Text("\n".join([*cut, "A page per model: probe-kit models NAME"]))


def _in_a_word(ready: str) -> str:
    return "download" if ready.startswith("needs download") else "no" if ready.startswith("needs") else ready[:7]


def _ready(family: "Family") -> str:
    """Say if a family can be run here. A third party's family may be wrong about itself, and only about itself."""
    try:
        lacking = family.missing()
    except (ImportError, ValueError, TypeError, AttributeError, OSError) as error:
        return f"unknown: {type(error).__name__}: {error}"
    return f"needs {lacking}" if lacking else "yes"


def _model_rows(name: str | None) -> list[dict[str, Any]]:
    from probe_kit.extract.needs import weights_needed
    from probe_kit.extract.parts import SCRIPTED
    from probe_kit.hooks.registry import find_family, own_families, third_party_families

    families = list(own_families().values())
    if name is not None:
        families = [] if name in SCRIPTED else [find_family(name, tuple(SCRIPTED))]
    rows = [
        {
            "model": family.name,
            "description": family.description,
            "checkpoint": family.default_checkpoint or ("your own" if family.needs_checkpoint else EMBEDDED),
            "streams": family.streams_text(),
            "embodiment": family.embodiment,
            "scene": str(family.home),
            "ready": _ready(family),
            "weights": weights_needed(family.name, None, {}, None),
            "notes": family.notes,
            "does": " and ".join(verb for verb, can in (("acts", family.acts), ("answers", family.reads)) if can),
            "protocols": {
                " ".join(filter(None, (protocol, row.variant))): row.settings()
                for protocol, first in family.protocols.items()
                for row in first.rows
            },
            "interventions": family.interventions_json(),
            "options": [
                {"name": option.name, "kind": option.kind.__name__, "help": option.help, "default": option.default}
                for option in family.options
            ],
        }
        for family in families
    ]
    scripted = dict.fromkeys(("checkpoint", "streams", "embodiment", "scene"), "")
    scripted |= {"weights": "", "ready": "yes", "notes": "no activations"}
    nothing: dict[str, Any] = {"protocols": {}, "interventions": None, "options": []}
    rows += [
        {"model": model, "description": text, **scripted, "does": "acts", **nothing}
        for model, text in SCRIPTED.items()
        if name in (None, model)
    ]
    third_party = third_party_families() if name is None else {}
    rows += [
        {"model": model, "description": text, **dict.fromkeys(scripted, ""), "ready": "?", "does": "?", **nothing}
        for model, text in third_party.items()
    ]
    return rows
