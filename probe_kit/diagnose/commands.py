"""The command `probe-kit diagnose`."""

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from rich.text import Text

from probe_kit._system.machine import AUTO
from probe_kit._tables.printing import Format, print_table
from probe_kit._terminal import options as common
from probe_kit._terminal.console import counter, duration, err, markup, print_json, progress, say, say_note
from probe_kit._terminal.field_options import command_with
from probe_kit._terminal.options import further_option
from probe_kit.diagnose.results import FRAMES, check_names, diagnosis_table
from probe_kit.errors import UsageError
from probe_kit.extract import commands as start
from probe_kit.extract.config_files import MovedOptions, moved_of
from probe_kit.extract.parts import SCRIPTED
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.sources.inputs import GIVE_WORDS, INSTRUCTION, describe_spellings, normal_form
from probe_kit.intervene.commands import Instructions, PairTable

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.extract.extraction import Extraction
    from probe_kit.intervene import ReplayFiles
    from probe_kit.intervene.pairs import PairRow
    from probe_kit.runs import Run
    from probe_kit.runs.plan import Row
    from probe_kit.runs.store import Location
    from probe_kit.train.command_options import TargetOptions

_ACTING = frozenset(
    {"model", "execute", "rotation", "no_act", "captured_calls", "later_views", "tokens", "frames", "video"}
    | {"inference_limit", "early_stop", "max_steps", "epsilon", "label", "accept_ignored_inputs"}
)
"""Options of runs that act, or store more than a diagnosis reads."""
ModelOrRun = Annotated[str, typer.Argument(metavar="MODEL|RUN", help="Model to diagnose, or folder of a run.")]
_OF_A_REPLAY = frozenset({"suite", "checkpoint", "model_option", "weights_seed", "device"})
"""Options of a new run that also name the present place of a stored run's model and suite."""
Frames = Annotated[
    int,
    typer.Option(
        "--frames",
        min=6,
        max=1000,
        metavar="N",
        help="Number of frames.",
    ),
]
Require = Annotated[
    common.Names | None,
    typer.Option(
        "--require",
        parser=common.Names.parse,
        metavar="A,B,…",
        help="Inputs that must matter, else the exit code is 1. Default: all that vary.",
    ),
]
Paraphrases = Annotated[
    Path | None,
    further_option(
        "--paraphrases",
        help="CSV file with the columns instruction and other: the same instruction in other words.",
    ),
]
Target = Annotated[
    str | None,
    typer.Option(
        "--target",
        metavar="COLUMN",
        help="Label that is probed: a side or a column.",
    ),
]
Labels = Annotated[
    Path | None, further_option("--labels", help="Table (CSV or Parquet) with the column that --target names.")
]
Base = Annotated[
    str | None,
    typer.Option(
        "--base",
        metavar="CHECKPOINT",
        help="Checkpoint before fine-tuning, to compare.",
    ),
]
Inside = Annotated[
    bool,
    further_option("--inside/--no-inside", help="Patch every site, to find the layer at which an input is lost."),
]
Html = Annotated[Path | None, typer.Option("--html", help="Also write an HTML page with a figure.")]


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
    instructions: Instructions = None,
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
    from probe_kit.intervene.further_instructions import read_instructions
    from probe_kit.intervene.pairs import read_pairs
    from probe_kit.train import Target
    from probe_kit.train.command_options import TargetOptions

    # A camera's name is known once the source is open; any other mistake is said before.
    check_names([name.partition(".")[0] for name in require or ()], names_of(()))
    if html is not None:
        check_writable(html)
    words = {} if paraphrases is None else read_paraphrases(paraphrases)
    table = () if pairs is None else read_pairs(pairs)
    task_words = () if instructions is None else read_instructions(instructions)
    if table and frames != FRAMES:
        raise UsageError("--frames N draws frames, and --pairs names them; leave one of both out")
    options = None if target is None else TargetOptions(target, labels, None, None, None)
    if options is not None:
        options.check(None)
        if labels is not None:
            Target.read(labels, options.name)  # a column that it lacks is said before anything is captured
    elif labels is not None:
        raise UsageError(f"--labels {labels} is a table of --target; name the column")
    request = _Request(frames, tuple(require or ()), table, base, task_words, options, inside)
    if _is_run(model_or_run, typed):
        run, source = _open_stored(model_or_run, typed, request), True
        _say_cost(run.model, list(run.streams.values()), _inputs_of(run, task_words), request)
    else:
        source = False
        extraction, location, most = _prepare_extraction(
            model_or_run, typed, request, out_folder, fetch=not dry_run
        )
        if not dry_run:
            run = _capture_frames(extraction, location, most)
    if dry_run:
        return
    with err.status("diagnosing") as status:
        diagnosis = diagnose_run(
            run,
            frames=frames,
            inside=inside,
            paraphrases=words,
            source=_replay_source(run, typed) if source else None,
            target=None if options is None else options.read(run),
            base=base,
            pairs=table,
            instructions=task_words,
            progress=lambda text: status.update(Text(text)),
        )
    if output_format == "json":
        print_json(diagnosis.to_json())
    else:
        print_table(diagnosis_table(diagnosis), output_format)
    if html is not None:
        from probe_kit.diagnose.page import write_page

        write_page(diagnosis, html)
        say(f"page: {html}")
    say(markup("run: [bold]{}[/]", run.location))
    raise typer.Exit(diagnosis.exit_code(require or ()))


class _Request(NamedTuple):
    """Options of a diagnosis that are checked against its run before the run is made, as far as it is known."""

    frames: int
    require: tuple[str, ...]
    pairs: "tuple[PairRow, ...]"
    base: str | None
    instructions: tuple[str, ...]
    target: "TargetOptions | None"
    inside: bool

    def check_cameras(self, cameras: Sequence[str]) -> None:
        """Raise UsageError for a required input that a model with these cameras does not have."""
        from probe_kit.diagnose.inputs import names_of

        check_names(self.require, names_of(cameras))

    def check_episodes(self, episodes: "pd.DataFrame", subject: str, in_scene: bool) -> None:
        """Raise UsageError for episodes of too few groups, and for further instructions that they have.

        Args:
            episodes: The episodes of a run, or the rows of a planned one.
            subject: The name of what has them.
            in_scene: Whether they are of the scene.
        """
        from probe_kit.diagnose.inputs import check_groups
        from probe_kit.intervene.further_instructions import check_further_instructions
        from probe_kit.statistics.sufficiency import GROUPS_FOR_PROBES

        if not self.pairs:
            check_groups(episodes, self.frames, in_scene, lambda: f"{subject} has")
        if self.instructions:
            words = episodes["instruction"].astype(str)
            check_further_instructions(self.instructions, words, bool(self.pairs))
        if self.target is None:
            return
        if not (self.target.is_label or in_scene):
            raise UsageError(
                f"--target {self.target.name} is a side, and {subject} has no correct picture on a side. Name a "
                "column, built in or of --labels"
            )
        if (groups := episodes["group_id"].nunique()) < GROUPS_FOR_PROBES:
            raise UsageError(
                f"{subject} has {groups} groups, and probes of --target {self.target.name} need "
                f"{GROUPS_FOR_PROBES} or more. Extract more episodes or items, or leave --target out"
            )


def check_writable(html: Path) -> None:
    """Raise UsageError for a page that cannot be written, before anything is loaded for it."""
    if html.is_dir():
        raise UsageError(f"--html {html} is a folder; give the name of a file")
    nearest = next(path for path in (html, *html.absolute().parents) if path.exists())
    if not os.access(nearest, os.W_OK) or not (nearest == html or nearest.is_dir()):
        raise UsageError(
            f"--html {html} cannot be written: {nearest} is no folder that can be; give another place"
        )


def _replay_source(run: "Run", typed: Mapping[str, Any]) -> "ReplayFiles":
    """Return where a stored run's model and source are now, by the options that were typed."""
    from probe_kit.hooks.contract.declared import read_pairs
    from probe_kit.intervene import ReplayFiles

    options = read_pairs(typed.get("model_option", ()))
    device, seed = typed.get("device", AUTO), typed.get("weights_seed")
    return ReplayFiles(typed.get("suite"), typed.get("checkpoint"), options, seed, device, moved_of(run, typed))


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


def _open_stored(name: str, typed: Mapping[str, Any], request: _Request) -> "Run":
    """Return a stored run that can be diagnosed as requested; raises what is known without its weights."""
    from probe_kit.diagnose.diagnosis import check_base, check_network
    from probe_kit.diagnose.inputs import cameras_of
    from probe_kit.hooks.registry import find_family
    from probe_kit.intervene.open_session import check_pairs, check_readable
    from probe_kit.runs import open_run

    run = open_run(name)
    check_network(run)
    find_family(run.model)  # a third party's, whose package may not be installed here
    request.check_cameras(cameras_of(run))
    request.check_episodes(run.episodes, str(run.location), run.source.is_scene)
    source = _replay_source(run, typed)
    if request.pairs:
        check_pairs(request.pairs, _frames_of_run(run, source))
    check_readable(run, source, request.instructions)
    if request.base is not None:
        check_base(run, source, request.base, cameras_of(run))
    for sentence in describe_spellings(run.episodes["instruction"].astype(str)):
        say_note(f"{sentence}.")
    return run


def _frames_of_run(run: "Run", source: "ReplayFiles") -> Collection[tuple[str, int]]:
    """Return the frames that a table of pairs may name: those of the source, or first frames of the scene."""
    from probe_kit.intervene.frame_session import Frames

    if run.source.is_scene:
        return {(str(episode), 0) for episode in run.episodes["episode_id"]}
    frames = Frames(run, source)
    try:
        return set(frames.by_name)
    finally:
        frames.close()


def _prepare_extraction(
    name: str, typed: Mapping[str, Any], request: _Request, out_folder: str | None, *, fetch: bool
) -> "tuple[Extraction, Location, int]":
    """Return the extraction of the frames that are used, and its largest cost, after both were printed.

    What is wrong with the request is raised before weights are read.
    """
    from probe_kit.diagnose.diagnosis import check_base_files
    from probe_kit.diagnose.results import count_groups
    from probe_kit.extract import prepare
    from probe_kit.extract.commands import print_plan
    from probe_kit.hooks.registry import get_family
    from probe_kit.runs.store import locate

    in_scene = not {"dataset", "env", "pictures"} & set(typed)
    # Of an environment too the first observation of an episode is all that is read.
    captured = {"no_act": True} if in_scene else {"max_steps": 1, "execute": 1} if "env" in typed else {}
    # A target is probed in all that is captured, and a table of pairs names any item: twice as many groups then.
    is_drawn = request.target is None and not request.pairs
    groups = count_groups(request.frames) if is_drawn else request.frames
    items = {"items": 2 * groups} if in_scene and "items" not in typed else {}
    # A policy that ignores both picture and instruction is what is looked for here.
    ignored = {"accept_ignored_inputs": True}
    settings = ExtractSettings.of_command({**typed, **items, "model": name, **captured, **ignored}, None)
    if "dataset" in typed and request.target is None:
        settings = settings.changed(source=settings.source.changed(single=True))
    model = settings.model
    if model.family in SCRIPTED:
        raise UsageError(f"{model.family} is scripted and has no network; diagnose a policy")
    if request.instructions and (family := get_family(model.family)) is not None:
        family.check_words(request.instructions, model.checkpoint)
        family.check_instructions(model.checkpoint, request.instructions, model.options, fetch)

    if request.target is not None and request.target.file is None:
        _check_target(request.target.name, in_scene, "env" in typed)

    def check_cameras(cameras: Sequence[str]) -> None:
        request.check_cameras(cameras)
        if request.base is not None:
            check_base_files(model.family, model.checkpoint, request.base, model.options, cameras, fetch)

    with err.status(f"loading {settings.source.loads} and model"):
        extraction = prepare(
            settings,
            out_folder,
            fetch=fetch,
            check_cameras=check_cameras,
            choose_rows=lambda rows: _chosen_rows(rows, request, settings.source.subject, in_scene),
        )
    target, columns = request.target, extraction.source.targets()
    is_recorded = not in_scene and "env" not in typed
    if is_recorded and target is not None and target.file is None and target.name not in columns:
        raise UsageError(f"--target {target.name!r} is no column here; there are {', '.join(columns) or 'none'}")
    location = locate(out_folder or Path("runs") / f"diagnose-{extraction.default_name()}")
    print_plan(extraction, location)
    source, rows = extraction.source, extraction.plan.episodes
    for sentence in source.same_instructions():
        say_note(f"{sentence}.")
    cameras = 1 + len(source.example(rows[0].instruction).cameras)
    texts = [*(row.instruction for row in rows), *request.instructions]
    inputs = _inputs(texts, cameras, in_scene)
    return extraction, location, _say_cost(model.family, extraction.plan.streams, inputs, request)


def _check_target(name: str, in_scene: bool, in_environment: bool) -> None:
    """Raise UsageError for a built-in target that a new run of a diagnosis cannot have, whatever its model."""
    from probe_kit.train.builtin_columns import ITEM, PLAYED, RECORDED, SIM
    from probe_kit.train.choices import CHOSEN, SIDES

    if in_scene and (name == CHOSEN or name.startswith(SIM)):
        raise UsageError(
            f"--target {name} is of what a policy did, and a new run of `probe-kit diagnose` captures first "
            "frames alone. Diagnose a run of `probe-kit extract` that acted"
        )
    prefix = ITEM if in_scene else PLAYED if in_environment else RECORDED
    if not name.startswith(prefix) and not (name in SIDES and in_scene):
        raise UsageError(f"--target {name} is of another source; built-in columns here are called {prefix}NAME")


def _chosen_rows(rows: "Sequence[Row]", request: _Request, subject: str, in_scene: bool) -> "Sequence[Row]":
    """Return the rows with the frames that a diagnosis uses, after it was checked against all of them.

    Of the scene they are all: its items are counted beforehand.
    """
    import pandas as pd

    from probe_kit.diagnose.inputs import spread_over_groups
    from probe_kit.intervene.open_session import check_pairs

    names = ("group_id", "item_id", "episode_id", "instruction", "category")
    episodes = pd.DataFrame([{name: row.columns[name] for name in names} for row in rows], columns=list(names))
    check_pairs(request.pairs, _planned_frames(rows, in_scene))
    request.check_episodes(episodes, f"the plan of {subject}", in_scene)
    if in_scene or request.target is not None:
        return rows
    if request.pairs:
        frames = {part for pair in request.pairs for part in (pair[:2], pair[2:])}
        return [row for row in rows if not frames.isdisjoint(_planned_frames([row], in_scene))]
    positions = spread_over_groups([str(row.columns["group_id"]) for row in rows], request.frames)
    return [rows[at] for at in sorted(positions)]


FEWEST_PACED = 3
"""Captured frames from which the time of an inference is taken."""


def _capture_frames(extraction: "Extraction", location: "Location", most: int) -> "Run":
    """Return the run of the planned frames, and say how long `most` inferences take by the pace of these."""
    ended: list[float] = []
    with progress() as bar:
        count = counter(bar, "frames")

        def advance(finished: int, total: int, *what: object) -> None:
            ended.append(monotonic())
            count(finished, total, *what)

        run = extraction.run(location, progress=advance)
    # The first one warms the network up; what was captured before took no time now, and workers load meanwhile.
    if len(ended) > FEWEST_PACED and extraction.controller is not None:
        seconds = most * (ended[-1] - ended[0]) / (len(ended) - 1)
        say(f"about {duration(seconds)} for at most {most:,} inferences, at the pace of the captured frames")
    return run


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


def _inputs_of(run: "Run", task_words: Sequence[str]) -> list[str]:
    """Return the inputs that can vary between the frames of a stored run."""
    from probe_kit.diagnose.inputs import cameras_of

    texts = [*run.episodes["instruction"].astype(str), *task_words]
    return _inputs(texts, len(cameras_of(run)), run.source.is_scene)


def _inputs(instructions: Iterable[str], cameras: int, in_scene: bool) -> list[str]:
    """Return the inputs that can vary between the frames; the scene always begins with one state."""
    pictures = ["picture"] if cameras == 1 else [f"{cameras} pictures"]
    words = {normal_form(text) for text in instructions}
    return [*["instruction"] * (len(words) > 1), *pictures * cameras, *["state"] * (not in_scene)]


def _say_cost(family: str, streams: "Sequence[Any]", inputs: Sequence[str], request: _Request) -> int:
    """Say and return at most how many inferences a diagnosis takes, of how many frames, inputs and sites."""
    from probe_kit.diagnose.measure import count_inferences
    from probe_kit.hooks.registry import get_family

    layers = {stream.name: stream.layers for stream in streams}
    declared = get_family(family)
    # Keys and values are of every block of the backbone, which has one residual site more.
    handed_over = (
        layers["backbone"] - 1 if declared is not None and declared.abilities.interventions.prompt_kv else 0
    )
    sites = sum(layers.values()) + handed_over if request.inside else 0
    frames, pairs, base = request.frames, len(request.pairs) or None, request.base is not None
    if request.pairs:
        frames = len({name for row in request.pairs for name in (row[:2], row[2:])})
    most = count_inferences(frames, len(inputs), sites, base, pairs)
    words = ", ".join(dict.fromkeys(inputs))
    say(f"at most {most:,} inferences: {frames} frames, {words}, {sites} sites" + ", and a base" * base)
    if INSTRUCTION not in inputs:
        say_note(f"the frames have one instruction, which cannot vary. {GIVE_WORDS}.")
    return most
