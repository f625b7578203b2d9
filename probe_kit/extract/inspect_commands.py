"""Commands that show: `models`, `run verify|copy|export`, `dataset show` and `check-environment`."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from probe_kit._system.escaping import terminal_safe
from probe_kit._terminal import options as common
from probe_kit._terminal.console import err, markup, out, print_json, print_text, say
from probe_kit._terminal.field_options import command_with
from probe_kit._terminal.options import LISTED, AsJson, Names, Partial, RunFolder, check_no_others
from probe_kit.errors import UsageError
from probe_kit.extract.parts import SCRIPTED, ActMachine, ModelSettings
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.sources.environment import EnvOptions
from probe_kit.extract.sources.recording import LeRobotSource
from probe_kit.hooks.contract.card import EMBEDDED
from probe_kit.runs.layout import DIRECTION_FILES, ExportFormat, SaeDtype

if TYPE_CHECKING:
    from probe_kit.hooks import Policy
    from probe_kit.hooks.family import Family


def models(
    name: Annotated[str | None, typer.Argument(help="Model to show. Default: all.")] = None,
    run: Annotated[
        str | None,
        typer.Option(
            metavar="RUN", help="Show what this run recorded of its model: weights, code, machine and checks."
        ),
    ] = None,
    words: Annotated[
        bool,
        typer.Option(
            "--words",
            help="List the words that the embedded models know, one per line. All other models read any text.",
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
        print_json([_row_json(row) for row in rows])
        return
    if name is None:
        out.print(_list_models(rows))
        return
    for row in rows:
        out.print(markup("[bold]{}[/]  {}", row["model"], row["description"]))
        for key in ("checkpoint", "streams", "embodiment", "scene", "does", "ready", "weights", "notes"):
            if row[key]:
                out.print(markup("  [dim]{}[/] {}", f"{key:10}", row[key]), soft_wrap=True)
        for protocol, settings in row["protocols"].items():
            line = ", ".join(f"{name} {value}" for name, value in settings.items())
            out.print(markup("  [dim]protocol  [/] {}: {}", protocol, line), soft_wrap=True)
        if (supported := row["interventions"]) is not None:
            readout = (
                ""
                if supported["readout"] == "first-chunk"
                else "; one action per inference, which says little alone"
            )
            supported_options = "; ".join(
                f"{option} {', '.join(values)}" for option, values in supported["asked_as"].items()
            )
            out.print(markup("  [dim]intervene [/] {}", f"{supported_options}{readout}"), soft_wrap=True)
        for option in row["options"]:
            default = f" Default {option['default']}." if option["default"] else ""
            line = f"-M {option['name']}={option['kind'].upper()}  {option['help']}{default}"
            out.print(markup("  [dim]option    [/] {}", line), soft_wrap=True)


def _print_words(name: str | None, run: str | None, as_json: bool) -> None:
    from probe_kit.hooks.registry import find_family, own_families

    check_no_others({"--run": run is not None}, "--words")
    families = list(own_families().values()) if name is None else [find_family(name, tuple(SCRIPTED))]
    if not any(family.abilities.vocabulary for family in families):
        raise UsageError(f"{name} reads any text; --words lists those of embedded models. Leave --words out")
    listed = sorted({word for family in families for word in family.known_words()})
    if as_json:
        print_json(listed)
    else:
        print_text("\n".join(listed))


def _list_models(rows: list[dict[str, Any]]) -> Text:
    """Return a line per model, its description cut behind a word where the console ends."""
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
    """Say whether a family can be run here; a third party's family may be wrong, but only about itself."""
    try:
        lacking = family.missing()
    except (ImportError, ValueError, TypeError, AttributeError, OSError) as error:
        return f"unknown: {type(error).__name__}: {error}"
    return f"needs {lacking}" if lacking else "yes"


def _model_rows(name: str | None) -> list[dict[str, Any]]:
    from probe_kit.extract.sizes import weights_needed
    from probe_kit.hooks.registry import find_family, own_families, third_party_families

    families = list(own_families().values())
    if name is not None:
        families = [] if name in SCRIPTED else [find_family(name, tuple(SCRIPTED))]
    rows = [
        {
            "model": family.name,
            "description": family.description,
            "checkpoint": family.default_checkpoint
            or ("your own" if family.requirements.needs_checkpoint else EMBEDDED),
            "streams": family.streams_text(),
            "embodiment": family.embodiment,
            "scene": str(family.home),
            "ready": _ready(family),
            "weights": weights_needed(family.name, None, {}, None),
            "notes": family.notes,
            "does": " and ".join(
                verb for verb, can in (("acts", family.abilities.acts), ("answers", family.abilities.reads)) if can
            ),
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


def _row_json(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a model's row with the numbers of its streams and weights in place of their words."""
    from probe_kit.extract.sizes import weights_bytes_needed
    from probe_kit.hooks.registry import own_families

    family = own_families().get(row["model"])
    numbers: dict[str, Any] = {} if family is None else {
        "streams": family.streams_json(), "weights": weights_bytes_needed(family.name),
    }  # fmt: skip
    # A family that declares no shapes, as an embedded one, says them in words alone.
    words = {} if numbers.get("streams") or not row["streams"] else {"streams_in_words": row["streams"]}
    return {**row, "streams": {}, "weights": {}, **numbers, **words}


# -- runs --------------------------------------------------------------------------------------------------------


run_app = typer.Typer(help="Inspect, verify, copy and export runs.", no_args_is_help=True)
DAMAGED = 1


@run_app.command("verify")
def verify(
    run: RunFolder,
    deep: Annotated[
        bool, typer.Option("--deep", help="Read every stored byte and compare it with its hash.")
    ] = False,
    build: Annotated[
        bool,
        typer.Option("--seal", help="First write the columns from which probes read the activations fast."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Check a run against its stored hashes; exit with 1 if anything is missing or changed."""
    from probe_kit.runs import seal, verify_run

    if build:
        say("sealed" if seal(run, deep=True) else "nothing to seal")
    audit = verify_run(run, deep)
    if as_json:
        print_json({**asdict(audit), "ok": audit.ok, "finished": audit.finished})
    else:
        checked = "every byte" if deep else "structure and sizes"
        sealed = "sealed" if audit.sealed else "not sealed"
        failed = f", {audit.failed} failed" if audit.failed else ""
        out.print(f"{audit.committed} of {audit.planned} episodes{failed}, {sealed}; {checked} checked")
        if audit.ok and not audit.finished:
            out.print(
                "whole, but not finished: if it was finished before, this is an older state of it. The same "
                "`probe-kit extract` continues it",
                soft_wrap=True,
            )
        if audit.left_out:
            out.print(f"a copy without activations: {', '.join(audit.left_out)}", soft_wrap=True)
        for stray in audit.strays:
            out.print(f"belongs to no part of the run: {stray}", highlight=False, markup=False, soft_wrap=True)
        for problem in audit.problems:
            out.print(f"damaged: {problem}", soft_wrap=True)
    if not audit.ok:
        raise typer.Exit(DAMAGED)


@run_app.command("copy")
def copy(
    run: RunFolder,
    out_folder: Annotated[str, typer.Argument(metavar="OUT", help="Folder or URL for the copy.")],
    pictures: Annotated[bool, typer.Option("--pictures", help="Copy frames and videos too.")] = False,
    partial: Partial = False,
) -> None:
    """Copy a run without its activations: outcomes, probes, interventions and certificates."""
    from probe_kit.runs import copy_run

    with err.status("copying"):
        out.print(str(copy_run(run, out_folder, pictures, partial).location), soft_wrap=True)


@run_app.command("export")
def export(
    run: RunFolder,
    style: Annotated[
        ExportFormat,
        typer.Option(
            "--format",
            help="Format. lerobot and sae write a folder. lerobot: what the policy saw and did in a scene, played "
            "again. directions: for intervene --direction FILE#NAME.",
        ),
    ],
    out_file: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE", help="File or folder to write. Default: <run>.<format> beside the run."
        ),
    ] = None,
    sites: Annotated[
        Names | None,
        typer.Option(
            "--sites",
            **LISTED,
            help="For parquet, sae and directions: sites, such as backbone.07, expert or expert.*@9. "
            "Default: all.",
        ),
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(
            "--view",
            help="For parquet, sae and directions: a pooled view, tokens or tokens:ROLE. Default: all "
            "pooled views, "
            "or mean in sae.",
        ),
    ] = None,
    dtype: Annotated[
        SaeDtype, typer.Option("--dtype", help="For sae: data type of the memory maps.")
    ] = "bfloat16",
    seed: Annotated[int, typer.Option("--seed", help="For sae: seed of the order of rows.")] = 0,
    suite: Annotated[
        Path | None, typer.Option("--suite", help="For lerobot: folder of the run's suite, if it was moved.")
    ] = None,
    arm_urdf: Annotated[
        Path | None, typer.Option("--arm-urdf", help="For lerobot: URDF file of the run's arm, if it was moved.")
    ] = None,
    background: Annotated[
        Path | None, typer.Option("--background", help="For lerobot: photo of the run's table, if it was moved.")
    ] = None,
    partial: Partial = False,
) -> None:
    """Write a run for other tools: to a file, and its sha256 beside it, or to a folder."""
    from probe_kit.runs import export_run
    from probe_kit.runs.store import locate

    location = locate(run)
    target = out_file or location.path_of_export(f"{location.name}.{DIRECTION_FILES.get(style, style)}")
    scene_files = {name: path for name, path in (("arm_urdf", arm_urdf), ("background", background)) if path}
    with err.status("exporting") as status:
        written = export_run(
            location, style, target, partial, sites=sites, view=view, dtype=dtype, seed=seed, suite=suite,
            scene_files=scene_files,
            on_episode=lambda done, count: status.update(f"exporting: {done} of {count} episodes"),
        )  # fmt: skip
    out.print(str(written), soft_wrap=True)


# -- data sets and environments ----------------------------------------------------------------------------------


FAILED = 1
_OFFERED = {
    "checkpoint", "model_option", "episodes", "select", "camera", "feature", "rotate", "instruction",
    "accept_units",
}  # fmt: skip
dataset_app = typer.Typer(help="Inspect data sets of recordings.", no_args_is_help=True)


@dataset_app.command("show")
@command_with(ModelSettings, ActMachine, LeRobotSource, offers=_OFFERED.__contains__)
def show_dataset(
    typed: Mapping[str, Any],
    folder: Annotated[
        str, typer.Argument(metavar="FOLDER", help="A LeRobotDataset, or USER/NAME@COMMIT of the hub.")
    ],
    model: Annotated[str | None, typer.Option("--model", help="Compare with the inputs of this model.")] = None,
) -> None:
    """Show what a data set holds and how a model would be shown it. Writes nothing.

    Files, numbers and videos of the chosen episodes are checked. With a model, the state of every chosen frame is
    compared with the statistics of the checkpoint. What `extract` refuses is an error here too.

    \b
    probe-kit dataset show FOLDER
    probe-kit dataset show FOLDER --model pi0 --checkpoint DIR --camera base=observation.images.top
    """  # noqa: D301 - click reads the \b
    from rich.table import Table

    from probe_kit.extract.commands import content_warning
    from probe_kit.extract.extraction import load
    from probe_kit.extract.sources.recording_source import RecordingSource

    settings = ExtractSettings.of_command({**typed, "model": model or "pi0-tiny", "dataset": folder})
    with err.status("reading the data set"):
        recording: RecordingSource = settings.source.open()  # type: ignore[assignment]  # of --dataset
        recording.check_frames()
        facts = recording.facts()
    if model is not None:
        with err.status("loading the model"):
            prepared = load(settings.changed(accept_units=True))  # units are checked behind the table
        recording = prepared.source  # type: ignore[assignment]
        policy: Policy = prepared.controller.model  # type: ignore[union-attr]  # scripts were refused
        facts |= recording.facts_of(policy, settings.machine.accept_units)
    table = Table(show_header=False, box=None)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts.items():
        table.add_row(name, markup("{}", terminal_safe(value)))
    out.print(table)
    for note in recording.content_notes():
        out.print(content_warning(note), soft_wrap=True)
    if model is not None:
        recording.check_recorded_units(policy, settings.machine.accept_units)


def check_environment(
    environment: Annotated[
        str,
        typer.Argument(metavar="MODULE:CLASS", help="Your environment, or lerobot:TYPE such as lerobot:libero."),
    ],
    env_options: EnvOptions = None,
    rotate: Annotated[
        list[str] | None,
        typer.Option(
            "--rotate", metavar="[CAMERA=]DEGREES", help="Rotate pictures as `extract --rotate` does, such as 180."
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            metavar="FILE",
            help="Image file to write: the first picture of every camera, side by side.",
        ),
    ] = None,
    as_json: common.AsJson = False,
) -> None:
    """Check an environment of your own against its contract, without a model.

    Two episodes of five actions are played, twice, and once in another process. Each check is one line: passed or
    failed, and the promise that is checked. A failure says what was seen and what was expected. Look at the file
    of --picture: where it stands on its head, give --rotate 180 here and to extract.

    Example: `probe-kit check-environment kitchen:Kitchen`

    Exits with 1 if a check failed.
    """
    from probe_kit.extract import EnvironmentSettings
    from probe_kit.extract import check_environment as checks_of
    from probe_kit.extract.sources.environment_check import STEPS

    source = EnvironmentSettings(environment, options=env_options or (), rotations=rotate or ())
    checks = []
    for check in checks_of(source, picture):
        checks.append(check)
        if not as_json:
            state, colour = ("passed", "green") if check.passed else ("failed", "bold red")
            out.print(markup(f"[{colour}]{{}}[/] {{}}", f"{state:8}", check.sentence), soft_wrap=True)
            if evidence := check.problem or check.facts:
                out.print(markup("         [dim]seen[/] {}", terminal_safe(evidence)), soft_wrap=True)
            for note in check.notes:
                moved = f", with {STEPS} small actions per episode"
                out.print(markup("         [yellow]without content[/] {}", note + moved), soft_wrap=True)
    failed = sum(not check.passed for check in checks)
    if as_json:
        listed = [{**asdict(check), "passed": check.passed} for check in checks]
        print_json({"environment": environment, "passed": not failed, "checks": listed})
    elif failed:
        out.print(f"{len(checks) - failed} passed, {failed} failed")
    else:
        out.print(f"{len(checks)} passed")
        options = [
            *(f"--env-option {quote(text)}" for text in env_options or ()),
            *(f"--rotate {quote(turn)}" for turn in rotate or ()),
        ]
        typed = " ".join([quote(environment), *options])
        say(markup("next: [bold]probe-kit extract --model NAME --env {} --out runs/own[/]", typed))
    raise typer.Exit(FAILED if failed else 0)
