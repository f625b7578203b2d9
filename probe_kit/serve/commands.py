"""The command `probe-kit serve`."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument, terminal_safe
from probe_kit._terminal import options as common
from probe_kit._terminal.console import err, markup, out, say
from probe_kit._terminal.field_options import command_with, options_of
from probe_kit.errors import UsageError
from probe_kit.extract.parts import ActMachine, ActTask, Capture, ModelSettings
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.sources.served import ServedSettings
from probe_kit.extract.states import count_calls

if TYPE_CHECKING:
    from probe_kit.runs import Run
    from probe_kit.serve.server import ServerPlan
    from probe_kit.serve.session import Line, Session

_NOT_SERVED = frozenset(
    ("protocol", "rotation", "no_act", "batch", "video", "frames", "env_workers", "workers", "ray",
     "inference_limit")
)  # fmt: skip
"""The options of `extract` that a server has no use for."""
LOOPBACK = "127.0.0.1"
CALLS = 8
"""The captured inferences of an episode by default; the time of sealing grows with them."""

Host = Annotated[
    str,
    typer.Option(
        "--host",
        help="Address of the server. Another one than 127.0.0.1 needs a token.",
        rich_help_panel="Network",
    ),
]
Port = Annotated[
    int,
    typer.Option(
        "--port", min=0, max=65535, help="Port of the server. 0: any free one.", rich_help_panel="Network"
    ),
]
TokenFile = Annotated[
    Path | None,
    typer.Option(
        "--token-file",
        metavar="FILE",
        help="File with the token that clients send. Without it, another --host than 127.0.0.1 draws one.",
        rich_help_panel="Network",
    ),
]
Metadata = Annotated[
    list[str] | None,
    typer.Option(
        "--metadata",
        metavar="KEY=JSON",
        help="Setting for clients of openpi, such as reset_pose=[0,0.1]: the server sends it when they connect. "
        "Repeatable.",
        rich_help_panel="Network",
    ),
]
StopAfter = Annotated[
    int | None,
    common.further_option(
        "--stop-after", min=1, metavar="N", help="Stop the server after this many stored episodes."
    ),
]
Out = Annotated[
    str,
    typer.Option("--out", metavar="FOLDER", help="Where to store the run: a folder or s3://BUCKET/PREFIX/RUN."),
]


@command_with(
    ModelSettings, Capture, ActTask, ActMachine, ExtractSettings, ServedSettings,
    offers=lambda name: name not in _NOT_SERVED,
)  # fmt: skip
def serve(
    typed: Mapping[str, Any],
    out_folder: Out,
    host: Host = LOOPBACK,
    port: Port = 8000,
    token_file: TokenFile = None,
    metadata: Metadata = None,
    stop_after: StopAfter = None,
    dry_run: common.DryRun = False,
) -> None:
    """Answer the wire of a benchmark or a robot, and store the activations of its episodes.

    The client plays; a run of its episodes is written here. Clients of openpi need no change. One more key in
    their observations, probe_kit/episode, names episodes. The harness vla-eval names its own. Ctrl-C commits what
    was played. The same command continues the run.

    \b
    probe-kit serve --model pi0 --checkpoint DIR --out runs/libero --camera base=observation/image \\
        --state observation/state --source libero_spatial@1
    probe-kit serve --model pi0 --checkpoint DIR --out runs/libero --wire vla-eval --state states
    probe-kit serve --model pi0-tiny --out runs/mine --state observation/state --dry-run
    """  # noqa: D301 - click reads the \b
    from probe_kit.serve.server import open_server, plan_server

    settings = settings_of(typed)
    extra_entries = _metadata(metadata or ())
    if dry_run:
        _print_plan(plan_server(settings, out_folder), f"ws://{host}:{port}")
        return
    with err.status("loading model"):
        server = open_server(settings, out_folder, host, port, token_file, extra_entries, _say_line)

    def ready() -> None:
        _print_plan(server.plan, server.address)
        if server.token_file is not None:
            say(markup("token: in [bold]{}[/], which only you can read", server.token_file))
        say(markup("[green]ready[/]; Ctrl-C commits what was played and ends"))
        out.print(server.address, soft_wrap=True)

    server.serve(stop_after, ready, lambda line: say(markup("[yellow]{}[/]", line)))
    with err.status("sealing"):
        run = server.close()
    _print_end(run, server.session)
    server.check_failed()


def _say_line(line: "Line") -> None:
    """Print what became of an episode."""
    number = "" if line.number is None else f"{line.number} "
    counts = f"{line.captured} of {plural(line.inferences, 'inference')} captured"
    style = "[red]{}[/]" if line.failure else "[green]{}[/]" if line.outcome == "success" else "{}"
    outcome = "captured" if line.outcome == "capture_only" else line.outcome
    end = f": {line.failure}" if line.failure else ""
    if line.possible_starts:
        end = f"{end}; may be more than one episode: {plural(line.possible_starts, 'state')} may be a reset"
    template = f"episode {{}}[bold]{{}}[/] of {{}}: {{}}, {{}} s, {style}{{}}"
    seconds = f"{line.seconds:.1f}"
    say(markup(template, number, line.episode, line.client, counts, seconds, outcome, end))


def _print_plan(plan: "ServerPlan", address: str) -> None:
    """Print which keys to send, what comes back, and what is stored."""
    from rich.table import Table

    from probe_kit.extract.sizes import weights_needed
    from probe_kit.runs.run_folders import in_units

    settings, calls, source = plan.fitted.settings, plan.fitted.calls, plan.source
    served: Any = settings.source
    capture = settings.capture
    cameras = [f"{key} → {camera}, uint8 (height, width, 3)" for camera, key in source.cameras]
    names = ", ".join(plan.cameras) or "unknown before the model is loaded"
    pictures = "; ".join(cameras) or f"a picture by the name of a camera ({names}), or the only one"
    words = f"none: --instruction {served.instruction!r}" if served.instruction else f"{served.words_key}, a text"
    per_call = sum(stream.raw_bytes(capture.tokens == "all", 1) for stream in plan.streams)
    episode = sum(stream.raw_bytes(capture.tokens == "all", calls, capture.later_views) for stream in plan.streams)
    chunk = tuple("?" if size is None else str(size) for size in plan.chunk)
    streams = "; ".join(f"{stream.name} {stream.layers} layers x {stream.width}" for stream in plan.streams)
    model = settings.model
    rows = {
        "model": model.family + (f" of {model.checkpoint}" if model.checkpoint else ""),
        "weights": weights_needed(model.family, model.checkpoint, model.options, model.dtype)
        if plan.origin
        else "",
        "wire": f"{served.wire} at {address}",
        "send": pictures,
        "state": " and ".join(served.state) + ", numbers of one axis" if served.state else "none is read",
        "words": words,
        **_wire_rows(settings, chunk),
        "stores": f"the first {plural(calls, 'inference')} of an episode"
        + (f", of each {served.every}th" if served.every > 1 else ""),
        "streams": (streams or "unknown before the model is loaded")
        + (f" ({plan.origin})" if plan.origin else ""),
        "activations": f"{in_units(per_call)} an inference, {in_units(episode)} an episode before compression",
        "source": served.name,
        "run": str(plan.location) + (" (continues)" if plan.stored is not None else ""),
    }
    table = Table(show_header=False, title="serve", box=None)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows.items():
        if value:
            table.add_row(markup("[dim]{}[/]", name), terminal_safe(value))
    err.print(table)


def _wire_rows(settings: ExtractSettings, chunk: tuple[str, ...]) -> dict[str, str]:
    """Return what says where episodes begin, and what an answer holds."""
    from probe_kit.serve.marks import KEY

    served: Any = settings.source
    conditions = [condition.name for condition in served.conditions]
    if served.wire == "vla-eval":
        execute = settings.task.execute or "as many as the checkpoint executes"
        return {
            "episodes": "EPISODE_START names task and episode_idx, EPISODE_END has the metrics",
            "comes back": f"actions, float32 ({chunk[-1]}), one per observation",
            "executed": f"{execute} of the {chunk[0]} actions of each chunk",
            "conditions": ", ".join(conditions),
        }
    condition = ", condition?" if conditions else ""
    return {
        "mark": f"{KEY}: {{id, group?, step?{condition}}}; alone {{end: true, facts: {{success: true}}}}"
        + ("" if served.rule == "said" else f"; without it: --episodes {served.rule}"),
        "comes back": f"actions, float32 ({', '.join(chunk)}): chunk and numbers",
        "conditions": ", ".join(conditions),
    }


def _print_end(run: "Run | None", session: "Session") -> None:
    from probe_kit.extract.commands import print_input_notes
    from probe_kit.runs.environment_success import possible_starts_of

    if run is None:
        say("no episode was played; nothing is stored")
        return
    refused = f", {plural(session.refused, 'observation')} refused" if session.refused else ""
    say(f"{plural(session.committed, 'episode')} committed{refused}; the run has {len(run.episodes)}")
    if len(run.episodes):
        print_input_notes(run)
        if note := possible_starts_of(run.episodes):
            say(markup("[yellow]{}[/]. --pause SECONDS or marks of the client bound them", note))
        partial = " --partial" if len(run.episodes) < run.planned else ""
        say(markup("next: [bold]probe-kit targets {}{}[/]", as_argument(run.location), partial))
    out.print(str(run.location), soft_wrap=True)


def settings_of(typed: Mapping[str, Any]) -> ExtractSettings:
    """Return the settings of a server from the options that were typed. Raises UsageError."""
    served = {option.parameter: option.field for option in options_of(ServedSettings)}
    parts = (ModelSettings, Capture, ActTask, ActMachine, ExtractSettings)
    fields = {option.parameter: option.field for part in parts for option in options_of(part)}
    source = ServedSettings(**{served[name]: value for name, value in typed.items() if name in served})
    values = {fields[name]: value for name, value in typed.items() if name in fields and name not in served}
    settings = ExtractSettings(values.pop("family", None), source=source, **{"captured_calls": CALLS, **values})
    # A client may infer at every step: `all` has its number here, and the run that is continued is compared by it.
    return count_calls(settings, execute=1).settings


def _metadata(texts: "list[str] | tuple[str, ...]") -> dict[str, Any]:
    entries = {}
    for text in texts:
        key, equals, value = text.partition("=")
        try:
            if not (key and equals) or key == "probe_kit":
                raise ValueError
            entries[key] = json.loads(value)
        except ValueError:
            raise UsageError(f"--metadata {text!r:.80}; expected KEY=JSON, such as reset_pose=[0,0.1]") from None
    return entries
