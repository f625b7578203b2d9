"""`probe-kit diagnose`."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from probe_kit._tables.printing import Format, print_table
from probe_kit._terminal import options as common
from probe_kit._terminal.console import counter, err, marked, print_json, progress, say
from probe_kit._terminal.field_options import command_with
from probe_kit._terminal.options import further_option
from probe_kit.diagnose.results import FRAMES, check_names, diagnosis_table
from probe_kit.errors import UsageError
from probe_kit.extract import commands as start
from probe_kit.extract.config_files import MovedOptions, moved_of
from probe_kit.extract.settings import ExtractSettings
from probe_kit.intervene.commands import PairTable

if TYPE_CHECKING:
    from probe_kit.extract.extraction import Extraction
    from probe_kit.intervene import ReplaySource
    from probe_kit.intervene.pairs import PairRow
    from probe_kit.runs import Run
    from probe_kit.runs.plan import Row
    from probe_kit.runs.store import Location

_ACTING = frozenset(
    {"model", "execute", "rotation", "no_act", "captured_calls", "later_views", "tokens", "frames", "video"}
    | {"inference_limit", "early_stop", "max_steps", "epsilon", "label", "accept_ignored_inputs"}
)
"""Options of runs that act, or store more than a diagnosis reads."""
ModelOrRun = Annotated[str, typer.Argument(metavar="MODEL|RUN", help="Model to diagnose, or folder of a run.")]
_OF_A_REPLAY = frozenset({"suite", "checkpoint", "model_option", "weights_seed", "device"})
"""Options of a new run that also name the present place of a stored run's model and suite."""
Frames = Annotated[
    int, typer.Option("--frames", min=6, max=1000, metavar="N", help="Number of frames, at least 6.")
]
Require = Annotated[
    common.Names | None,
    typer.Option(
        "--require",
        parser=common.Names.parse,
        metavar="A,B,…",
        help="Inputs that must matter. Default: all that vary.",
    ),
]
Paraphrases = Annotated[
    Path | None,
    further_option(
        "--paraphrases", help="CSV file with columns instruction, other: the same meaning in other words."
    ),
]
Target = Annotated[
    str | None,
    typer.Option(
        "--target",
        metavar="COLUMN",
        help="Probe a side or a column, built in or of --labels.",
    ),
]
Labels = Annotated[Path | None, further_option("--labels", help="Table with the column of --target.")]
Base = Annotated[
    str | None,
    typer.Option("--base", metavar="CHECKPOINT", help="Compare with the checkpoint that this one was tuned from."),
]
Inside = Annotated[
    bool, further_option("--inside/--no-inside", help="Patch every site, to find where an input is lost.")
]
Html = Annotated[Path | None, typer.Option("--html", help="Also write a page with a figure.")]


@command_with(*ExtractSettings.option_models(), offers=lambda name: name not in _ACTING)
def diagnose(
    typed: Mapping[str, Any],
    model_or_run: ModelOrRun,
    frames: Frames = FRAMES,
    require: Require = None,
    target: Target = None,
    labels: Labels = None,
    base: Base = None,
    paraphrases: Paraphrases = None,
    pairs: PairTable = None,
    inside: Inside = True,
    out_folder: start.OutFolder = None,
    html: Html = None,
    output_format: Format = "table",
    dry_run: common.DryRun = False,
) -> None:
    """Does each input reach the action, does it matter, and where is it lost?

    Varies one input and holds the others. The exit code is 1 if one does not matter.

    \b
    probe-kit diagnose pi0-tiny --categories color
    probe-kit diagnose pi0 --checkpoint DIR --dataset FOLDER --require instruction
    probe-kit diagnose runs/mine --base lerobot/pi0_base
    probe-kit diagnose runs/mine --target side.correct
    """  # noqa: D301
    from probe_kit.diagnose.diagnosis import diagnose_run
    from probe_kit.diagnose.inputs import names_of, read_paraphrases
    from probe_kit.intervene.pairs import read_pairs
    from probe_kit.train.command_options import TargetOptions

    # A camera's name is known once the source is open; any other mistake is said before.
    check_names([name.partition(".")[0] for name in require or ()], names_of(()))
    words = {} if paraphrases is None else read_paraphrases(paraphrases)
    table = () if pairs is None else read_pairs(pairs)
    if table and frames != FRAMES:
        raise UsageError("--frames N draws frames, and --pairs names them; leave one of both out")
    options = None if target is None else TargetOptions(target, labels, None, None, None)
    if options is not None:
        options.check(None)
    elif labels is not None:
        raise UsageError(f"--labels {labels} is a table of --target; name the column")
    request = _Request(frames, tuple(require or ()), table, base)
    if dry_run:
        _say_cost(_planned(model_or_run, typed, request, out_folder), request, inside)
        return
    run = _run_of(model_or_run, typed, request, out_folder)
    with err.status("diagnosing") as status:
        diagnosis = diagnose_run(
            run,
            frames=frames,
            inside=inside,
            paraphrases=words,
            source=_replay_source(run, typed) if _is_run(model_or_run, typed) else None,
            target=None if options is None else options.read(run),
            base=base,
            pairs=table,
            progress=lambda text: status.update(text),
        )
    if output_format == "json":
        print_json(diagnosis.to_json())
    else:
        print_table(diagnosis_table(diagnosis), output_format)
    if html is not None:
        from probe_kit.diagnose.page import write_page

        write_page(diagnosis, html)
        say(f"page: {html}")
    say(marked("run: [bold]{}[/]", run.location))
    raise typer.Exit(diagnosis.exit_code(require or ()))


class _Request(NamedTuple):
    """Options of a diagnosis that are checked against its run before the run is made, as far as it is known."""

    frames: int
    require: tuple[str, ...]
    pairs: "tuple[PairRow, ...]"
    base: str | None

    def check_cameras(self, cameras: Sequence[str]) -> None:
        """Raise UsageError for a required input that a model with these cameras does not have."""
        from probe_kit.diagnose.inputs import names_of

        check_names(self.require, names_of(cameras))


def _replay_source(run: "Run", typed: Mapping[str, Any]) -> "ReplaySource":
    """Return where a stored run's model and source are now, by the options that were typed."""
    from probe_kit.hooks.contract.declared import read_pairs
    from probe_kit.intervene import ReplaySource

    options = read_pairs(typed.get("model_option", ()))
    device, seed = typed.get("device", "cpu"), typed.get("weights_seed")
    return ReplaySource(typed.get("suite"), typed.get("checkpoint"), options, seed, device, moved_of(run, typed))


def _is_run(name: str, typed: Mapping[str, Any]) -> bool:
    """Whether this is a stored run.

    Options that name a place or the device may be given with a stored run; they are no settings of a new one.

    Raises:
        UsageError: For a stored run with settings of a new one.
    """
    from probe_kit.runs.layout import RUN_FILE

    if "/" not in name and not (Path(name) / RUN_FILE).exists():
        return False
    if new := [option for option in typed if option not in MovedOptions.model_fields.keys() | _OF_A_REPLAY]:
        option = new[0].replace("_", "-")
        raise UsageError(f"--{option} is a setting of a new run, and {name} is a stored one; leave it out")
    return True


def _run_of(name: str, typed: Mapping[str, Any], request: _Request, out_folder: str | None) -> "Run":
    """Return the stored run of this name, or one that is extracted now."""
    if _is_run(name, typed):
        return _stored(name, request)
    extraction, location = _prepared(name, typed, request, out_folder, fetch=True)
    with progress() as bar:
        return extraction.run(location, progress=counter(bar, "episodes"))


def _stored(name: str, request: _Request) -> "Run":
    from probe_kit.diagnose.diagnosis import check_network
    from probe_kit.diagnose.inputs import cameras_of
    from probe_kit.runs import open_run

    run = open_run(name)
    check_network(run)
    request.check_cameras(cameras_of(run))
    return run


def _prepared(
    name: str, typed: Mapping[str, Any], request: _Request, out_folder: str | None, *, fetch: bool
) -> "tuple[Extraction, Location]":
    from probe_kit.diagnose.diagnosis import check_base_files
    from probe_kit.extract import prepare
    from probe_kit.extract.commands import print_plan
    from probe_kit.intervene.open_session import check_pairs
    from probe_kit.runs.store import locate

    in_scene = not {"dataset", "env", "pictures"} & set(typed)
    # Of an environment too the first observation of an episode is all that is read.
    captured = {"no_act": True} if in_scene else {"max_steps": 1, "execute": 1} if "env" in typed else {}
    # Twice as many groups as are exchanged: a target is probed in all of them.
    items = {"items": 2 * request.frames} if in_scene and "items" not in typed else {}
    # A policy that ignores both picture and instruction is what is looked for here.
    ignored = {"accept_ignored_inputs": True}
    settings = ExtractSettings.of_command({**typed, **items, "model": name, **captured, **ignored}, None)
    with err.status(f"loading {settings.source.loads} and model"):
        extraction = prepare(settings, out_folder, fetch=fetch, check_cameras=request.check_cameras)
    if request.base is not None:
        model, cameras = settings.model, extraction.source.shown_cameras()
        check_base_files(model.family, model.checkpoint, request.base, model.options, cameras or (), fetch)
    check_pairs(request.pairs, _planned_frames(extraction.plan.episodes, in_scene))
    location = locate(out_folder or Path("runs") / f"diagnose-{extraction.default_name()}")
    print_plan(extraction, location)
    return extraction, location


def _planned_frames(rows: "Iterable[Row]", in_scene: bool) -> dict[tuple[str, int], None]:
    """Return the frames that a run will have, by the names that a table of pairs may give them.

    Of the scene they are first frames.
    """
    names = ("episode_id",) if in_scene else ("episode_id", "item_id", "source_episode")
    return {
        (str(row.columns[name]), number): None
        for row in rows
        for number in row.frames or (0,)
        for name in names
        if name in row.columns
    }


Planned = tuple[str, Sequence[Any], list[str]]
"""The family, the stored streams, and the inputs that can vary."""


def _planned(name: str, typed: Mapping[str, Any], request: _Request, out_folder: str | None) -> Planned:
    """Return the parts that a diagnosis of this run, or of a planned one, would exchange and patch."""
    from probe_kit.diagnose.inputs import cameras_of
    from probe_kit.intervene.settings import has_sides

    if _is_run(name, typed):
        run = _stored(name, request)
        inputs = _inputs(run.episodes["instruction"], len(cameras_of(run)), has_sides(run))
        return run.model, list(run.streams.values()), inputs
    extraction, _ = _prepared(name, typed, request, out_folder, fetch=False)
    source, rows = extraction.source, extraction.plan.episodes
    cameras = source.example(rows[0].instruction).cameras
    inputs = _inputs((row.instruction for row in rows), 1 + len(cameras), source.suite is not None)
    return extraction.settings.model.family, extraction.plan.streams, inputs


def _inputs(instructions: Iterable[str], cameras: int, in_scene: bool) -> list[str]:
    """Return the inputs that can vary between the frames; the scene always begins with one state."""
    pictures = ["picture"] if cameras == 1 else [f"{cameras} pictures"]
    return [*["instruction"] * (len(set(instructions)) > 1), *pictures * cameras, *["state"] * (not in_scene)]


def _say_cost(planned: Planned, request: _Request, inside: bool) -> None:
    from probe_kit.diagnose.measure import count_inferences
    from probe_kit.hooks.registry import get_family

    family, streams, inputs = planned
    layers = {stream.name: stream.layers for stream in streams}
    declared = get_family(family)
    # Keys and values are of every block of the backbone, which has one residual site more.
    handed_over = layers["backbone"] - 1 if declared is not None and declared.interventions.prompt_kv else 0
    sites = sum(layers.values()) + handed_over if inside else 0
    frames, pairs, base = request.frames, len(request.pairs) or None, request.base is not None
    if request.pairs:
        frames = len({name for row in request.pairs for name in (row[:2], row[2:])})
    most = count_inferences(frames, len(inputs), sites, base, pairs)
    words = ", ".join(dict.fromkeys(inputs))
    say(f"at most {most:,} inferences: {frames} frames, {words}, {sites} sites" + ", and a base" * base)
