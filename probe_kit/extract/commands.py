"""The commands `probe-kit extract` and `probe-kit ask`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument, terminal_safe
from probe_kit._terminal import options as common
from probe_kit._terminal.console import counter, err, markup, out, print_json, progress, say
from probe_kit._terminal.field_options import command_with
from probe_kit._terminal.options import Names, read_size
from probe_kit.errors import DiskSpaceError, UsageError
from probe_kit.extract.config_files import read_config
from probe_kit.extract.parts import stored_option
from probe_kit.extract.settings import AskSettings, ExtractSettings
from probe_kit.extract.sources.scene import SceneOptions

if TYPE_CHECKING:
    from rich.text import Text

    from probe_kit.extract import Extraction
    from probe_kit.extract.settings import Settings
    from probe_kit.runs import Run
    from probe_kit.runs.store import Location


class Sizes(tuple[tuple[int, int], ...]):
    """Comma-separated sizes of pictures, (width, height) in pixels each."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: "str | Sizes") -> "Sizes":
        """Return the sizes of `text`, each WIDTHxHEIGHT; a default that is no text is returned as it is."""
        if not isinstance(text, str):
            return text
        return cls(map(read_size, several("--picture-size", text)))

    def __str__(self) -> str:
        """Return the sizes as they are typed."""
        return ",".join(f"{width}x{height}" for width, height in self)


def several(option: str, text: str | Names) -> Names:
    """Return the parts of a comma-separated option. Raises UsageError for none."""
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
        help="Prompts, comma-separated: seen, p1, p2 (from the paper), instruction (the words that policies "
        "get) or text files. In a file, {object} stands for the object, {A} and {B} for the sides.",
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
    bool,
    stored_option("--yes", help="Start although the run may take more than 64 GB of disk (before compression)."),
]

ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="Take all settings from a file of --print-config, or from a run. Options that you type take "
        "precedence.",
    ),
]
PrintConfig = Annotated[
    bool, typer.Option("--print-config", help="Print all settings as a file for --config, and stop.")
]


LARGE = 64 * 10**9
"""The bytes above which a run is begun with --yes only."""


@command_with(*ExtractSettings.option_models())
def extract(
    typed: Mapping[str, Any],
    out_folder: OutFolder = None,
    config: ConfigFile = None,
    print_config: PrintConfig = False,
    dry_run: common.DryRun = False,
    force: common.Force = False,
    large: Large = False,
) -> None:
    """Run a model in every episode and store its activations.

    The same command resumes an interrupted run. With more items, categories or wordings the run grows and keeps
    what it has. Other settings in the same folder are an error.

    \b
    probe-kit extract --model pi0-tiny --items 12 --out runs/mine
    probe-kit extract --model pi0 --categories color,shape --dry-run
    probe-kit extract --model pi0 --checkpoint DIR --dataset FOLDER --episodes 0:5 --select every:5
    probe-kit extract --model pi0 --checkpoint DIR --env kitchen:Kitchen --captured-calls 8
    """  # noqa: D301 - click reads the \b
    settings = ExtractSettings.of_command(typed, None if config is None else read_config(config, typed))
    if print_config:
        print_json(settings.config())
        return
    from probe_kit.extract import prepare
    from probe_kit.runs.store import locate

    with err.status(f"loading {settings.source.loads} and model"):
        extraction = prepare(settings, out_folder, fetch=not dry_run)
    location = locate(out_folder or Path("runs") / extraction.default_name())
    print_plan(extraction, location)
    print_sufficiency(extraction)
    if dry_run:
        return
    check_size(extraction, location, large)
    with progress() as bar:
        run = extraction.run(location, force=force, progress=counter(bar, "episodes"))
    _print_outcomes(run)


def print_plan(extraction: "Extraction", location: "Location") -> None:
    """Print the plan of a run, how much it stores and where."""
    from rich.table import Table

    from probe_kit.extract.sizes import space_needed
    from probe_kit.runs.run_folders import in_units
    from probe_kit.runs.writer import growth_words

    plan, identity, free = extraction.plan, extraction.identity(), location.free_bytes()
    accepted = extraction.settings.machine.accept_units
    calibrated, measures = extraction.calibration, extraction.settings.machine.batch == "auto"
    needed = in_units(sum(space_needed(extraction.further_plan(location), extraction.fitted).values()))
    weights = "not read" if extraction.declared else (identity["weights_sha256"] or "scripted")[:12]
    source = f" ({extraction.declared}; the weights were not read)" if extraction.declared and plan.streams else ""
    rows = {
        "model": f"{identity['model']}  weights {weights}" + ("  RANDOM" if identity["random_weights"] else ""),
        "weights": _weights(extraction),
        "device": extraction.settings.machine.device if plan.streams or extraction.controller else "",
        "units": _units(extraction.settings),
        "protocol": _protocol(identity),
        **extraction.source.describe(plan.episodes),
        **{name: terminal_safe(note.words) for name, note in extraction.source.unit_notes(accepted).items()},
        "grows": growth_words(location, plan),
        "streams": ("; ".join(_describe(s) for s in plan.streams) or "none") + source,
        "acts": _acts(identity, extraction.settings.source.subject),
        "activations": f"{plan.sites} sites, {plan.bytes / 1e6:,.1f} MB before compression",
        "disk": f"up to {needed} with columns, probes and report; "
        + ("no bound" if free is None else f"{in_units(free)} free"),
        "pace": calibrated.words if calibrated else "batch auto: chosen when the model runs" if measures else "",
        "run": str(location),
    }
    table = Table(show_header=False, title="plan", box=None)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")  # a path that is cut off is no path
    for name, value in rows.items():
        if value:
            table.add_row(markup("[dim]{}[/]", name), value)
    err.print(table)
    for note in extraction.source.content_notes():
        err.print(content_warning(note))


def content_warning(note: str) -> "Text":
    """Return a sentence about an input without content as a line of a terminal."""
    return markup("[yellow]without content:[/] {}; scores of its probes are no evidence", note)


def _weights(extraction: "Extraction") -> str:
    """Return memory and download of a model whose size is known."""
    from probe_kit.extract.sizes import weights_needed

    model: Any = getattr(extraction.controller, "model", None)
    loaded, requested = None if model is None else model.card.parameters, extraction.settings.model
    return weights_needed(requested.family, requested.checkpoint, requested.options, requested.dtype, loaded)


def _units(settings: "Settings") -> str:
    """Return the units that actions get, of a family whose checkpoints have several."""
    from probe_kit.hooks.registry import get_family

    family, model = get_family(settings.model.family), settings.model
    return "" if family is None else family.whose_units(model.checkpoint, model.options, fetch=False)


def _acts(identity: Mapping[str, Any], subject: str) -> str:
    """Return why a model does not act on a source of this subject; empty for one that acts."""
    reasons = {"recordings": "recorded frames are shown", "pictures": "pictures are shown"}
    reason = reasons.get(subject, "only captured, once per episode")
    return f"no: {reason}; no success rate" if identity.get("capture_only") else ""


def _protocol(identity: Mapping[str, Any]) -> str:
    if "protocol" not in identity:
        return ""
    protocol = identity["protocol"]
    changed = ", ".join(f"{name}={run} instead of {was}" for name, (was, run) in protocol["deviations"].items())
    name = " ".join(filter(None, (protocol["name"], protocol.get("variant"))))
    return name + (f", but {changed}" if changed else ", as released")


def _describe(stored: Any) -> str:
    steps = f" x {stored.iterations} iterations" if stored.iterations else ""
    return f"{stored.name} {stored.layers} layers{steps} x {stored.tokens} tokens x {stored.width}"


def print_sufficiency(extraction: "Extraction") -> None:
    """Print which analyses the plan has enough items for, before any work; too few items in yellow."""
    from rich.table import Table

    from probe_kit.suite.sufficiency import GROUPS_FOR_PROBES, Smallest, sufficiencies

    plan, source, suite = extraction.plan, extraction.source, extraction.source.suite
    if suite is None:
        groups = len({row.columns["group_id"] for row in plan.episodes})
        if groups < GROUPS_FOR_PROBES:
            more = source.smaller_groups(plan.episodes) if len(plan.episodes) >= GROUPS_FOR_PROBES else ""
            few = f"{groups} {source.groups}; probes need {GROUPS_FOR_PROBES} or more" + f". {more}" * bool(more)
            say(markup("[yellow]{}[/]", few))
        return
    scored = not extraction.identity().get("capture_only")
    table = Table(show_header=False, title=f"enough for ({Smallest.of(suite).words})", box=None)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for sufficiency in sufficiencies(suite, scored, bool(plan.streams)):
        table.add_row(
            sufficiency.name, markup("[yellow]{}[/]" if sufficiency.enough is False else "{}", sufficiency.words)
        )
    err.print(table)


def check_size(extraction: "Extraction", location: "Location", agreed: bool) -> None:
    """Raise DiskSpaceError for more than 64 GB, unless that was agreed to."""
    from probe_kit.extract.sizes import space_needed
    from probe_kit.runs.run_folders import in_units

    needed = sum(space_needed(extraction.further_plan(location), extraction.fitted).values())
    if needed > LARGE and not agreed:
        raise DiskSpaceError(
            f"{location} would take up to {in_units(needed)}; more than {in_units(LARGE)} is written with --yes "
            "only. Add --yes, or make the run smaller: fewer episodes, inferences (--captured-calls) or frames "
            "(--select every:N), or no --tokens all"
        )


def _next_command(run: "Run") -> str:
    """Return the command that reads the run: its targets, its probes if it has groups enough, else success."""
    from probe_kit.suite.sufficiency import probe_command

    if run.streams and run.inputs is not None:
        return f"probe-kit targets {as_argument(run.location)}"
    groups = run.episodes.groupby("category")["group_id"].nunique().to_dict() if run.streams else {}
    return probe_command(run.location, groups) or f"probe-kit retention {as_argument(run.location)}"


def print_input_notes(run: "Run") -> None:
    """Print which inputs have no content, and which did not change the first output, in yellow."""
    from probe_kit.runs.provenance import input_notes
    from probe_kit.runs.run_inputs import notes_of_content

    for note in notes_of_content(run):
        say(content_warning(note))
    for note in input_notes(run.certificate):
        say(
            markup(
                "[yellow]{}; [bold]probe-kit diagnose {}[/] says where it is lost[/]",
                note,
                as_argument(run.location),
            )
        )


def _print_outcomes(run: "Run") -> None:
    from probe_kit.runs.environment_success import EnvironmentSuccess

    counts = run.episodes["outcome"].value_counts()
    text = ", ".join(f"{name} {count}" for name, count in counts.items())
    text = "captured without acting" if run.capture_only else text
    say(f"{plural(len(run.episodes), 'episode')}: {text}")
    if (success := EnvironmentSuccess.of(run.episodes)) is not None:
        say(markup("[yellow]{}[/]" if success.stopped else "{}", success.sentence))
    print_input_notes(run)
    say(markup("next: [bold]{}[/]", _next_command(run)))
    out.print(str(run.location), soft_wrap=True)


# -- ask ---------------------------------------------------------------------------------------------------------


OWN_SCENE = frozenset(SceneOptions.model_fields) - {"scene"} | {"wordings"}
"""The fields of a scene that questions leave as they are."""


@command_with(*AskSettings.option_models(), offers=lambda name: name not in OWN_SCENE)
def ask(
    typed: Mapping[str, Any],
    prompt: Prompts = None,
    picture_size: PictureSizes = None,
    out_folder: AskOutFolder = None,
    config: ConfigFile = None,
    dry_run: common.DryRun = False,
    force: common.Force = False,
) -> None:
    """Ask a vision-language model about the first frame of every episode.

    Makes one run per prompt and picture size. Use the --suite, --protocol, --scene and --seed of the policy runs
    to compare with. Every question is asked in both orders of the options. Answers are read from the text and from
    the logits of the options. Compare with policies by `probe-kit compare ASKED… ACTED…`, also with
    --kind stages. Recordings, environments and pictures have no objects: their instruction is the question, and
    stored activations are probed for their labels.

    The same command resumes interrupted runs. With more items or categories they grow and keep what they have.
    Other settings in the same folder are an error.
    """
    from probe_kit.extract.extraction import prepare_asks
    from probe_kit.runs.store import locate

    requested = AskSettings.per_prompt_and_size(
        prompt, picture_size, typed, None if config is None else read_config(config, typed, asks=True)
    )
    places = [
        None if out_folder is None else f"{out_folder.rstrip('/')}/{settings.short_name}" for settings in requested
    ]
    runs: list[Run] = []
    prepared = prepare_asks(requested, places, fetch=not dry_run)
    for number, folder in enumerate(places):
        with err.status("loading suite and model"):
            extraction = next(prepared)
        location = locate(folder or Path("runs") / extraction.default_name())
        print_plan(extraction, location)
        if number == 0:  # of all of them, because they ask about the same items
            print_sufficiency(extraction)
        if not dry_run:
            with progress() as bar:
                runs.append(extraction.run(location, force=force, progress=counter(bar, "questions")))
    if not dry_run:
        _print_answers(runs)


def _print_answers(runs: "Sequence[Run]") -> None:
    """Print the outcomes of each run, its folder, and the next command."""
    import pandas as pd

    from probe_kit.runs.reader import SIDE

    for run in runs:
        episodes = run.episodes
        counts = ", ".join(f"{name} {count}" for name, count in episodes["outcome"].value_counts().items())
        unread = episodes.loc[episodes["outcome"] == "oob"].get("parse", pd.Series(dtype=str)).value_counts()
        reasons = f" ({', '.join(f'{name} {count}' for name, count in unread.items())})" if len(unread) else ""
        mass = f"; option mass {episodes['option_mass'].mean():.2f}" if "option_mass" in episodes else ""
        say(f"{run.label}: {counts}{reasons}{mass}")
        print_input_notes(run)
        out.print(str(run.location), soft_wrap=True)
    if SIDE not in runs[0].episodes:
        step = "targets {}" if runs[0].streams else "labels {}"
        say(markup(f"next: [bold]probe-kit {step}[/]", as_argument(runs[0].location)))
        return
    locations = " ".join(as_argument(run.location) for run in runs)
    say(markup("next: [bold]probe-kit compare {}[/]  add policy runs of the suite", locations))
