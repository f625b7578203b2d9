"""`probe-kit extract`."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe_kit._terminal.console import counter, err, marked, out, progress, say, split, whole_number
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from probe_kit.env import SceneSpec
    from probe_kit.extract import Extraction, Run
    from probe_kit.extract.store.locations.location import Location
    from probe_kit.suite.ladder import Wording

SCENE = "Scene (recorded with the run)"


def extract(
    model: Annotated[str, typer.Option(help="A model of `probe-kit models`, or expert, expert-mirrored, idle.")],
    out_folder: Annotated[
        str | None,
        typer.Option("--out", help="Folder or s3://BUCKET/PREFIX/RUN; default runs/<model>-<settings hash>."),
    ] = None,
    checkpoint: Annotated[str | None, typer.Option(help="Folder or hub id; default the family's.")] = None,
    random_weights: Annotated[
        bool, typer.Option("--random-weights", help="Untrained twin of the same architecture, as a control.")
    ] = False,
    weights_seed: Annotated[
        int, typer.Option(help="Seed of --random-weights; other seeds are other untrained twins.")
    ] = 0,
    model_option: Annotated[
        list[str] | None,
        typer.Option(
            "--model-option",
            "-M",
            metavar="KEY=VALUE",
            help="An option of this model; `probe-kit models NAME` lists them. May be repeated.",
        ),
    ] = None,
    label: Annotated[
        str | None, typer.Option(help="What tables call this run; default the model and what sets it apart.")
    ] = None,
    suite: Annotated[Path | None, typer.Option(help="Suite folder; default the embedded suite.")] = None,
    categories: Annotated[str | None, typer.Option(help="Comma-separated; default all of the suite.")] = None,
    items: Annotated[int | None, typer.Option(help="Items per category, even; default all.")] = None,
    wordings: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated: knowledge, named, side, neutral. Every item in each of them, on the same "
            "seeds; default its own words (knowledge)."
        ),
    ] = None,
    protocol: Annotated[
        str | None, typer.Option(help="act2answer: scene, checkpoint and options as released; what you give wins.")
    ] = None,
    scene: Annotated[
        str | None,
        typer.Option(
            help="bridge, frontal, vl-think or act2answer; default the protocol's, else the one the model was "
            "made for (`probe-kit models NAME`), mostly bridge."
        ),
    ] = None,
    max_steps: Annotated[
        int | None, typer.Option(help="Actions per episode, at 5 Hz.", rich_help_panel=SCENE)
    ] = None,
    tile_side: Annotated[
        float | None,
        typer.Option(help="Metres; the paper's sizes are 0.1452, 0.2033, 0.1162.", rich_help_panel=SCENE),
    ] = None,
    light_level: Annotated[
        float | None, typer.Option(help="1 is default; the paper's levels are 0.7, 1.3.", rich_help_panel=SCENE)
    ] = None,
    rendering: Annotated[
        str | None, typer.Option(help="raw, or visual-matching: over a photo.", rich_help_panel=SCENE)
    ] = None,
    background: Annotated[
        Path | None, typer.Option(help="Photo for visual-matching; default our own.", rich_help_panel=SCENE)
    ] = None,
    picture_size: Annotated[
        str | None, typer.Option(help="What the policy is handed, such as 224x224.", rich_help_panel=SCENE)
    ] = None,
    epsilon: Annotated[
        float | None, typer.Option(help="Zone radius, metres; default half a tile + 0.01.", rich_help_panel=SCENE)
    ] = None,
    arm: Annotated[str | None, typer.Option(help="panda or widowx.", rich_help_panel=SCENE)] = None,
    arm_urdf: Annotated[
        Path | None, typer.Option(help="Your own description of that arm.", rich_help_panel=SCENE)
    ] = None,
    start_grasped: Annotated[
        bool, typer.Option("--start-grasped", help="Begin with the cube in hand.", rich_help_panel=SCENE)
    ] = False,
    early_stop: Annotated[
        bool, typer.Option("--early-stop", help="End when the cube was released and rests.", rich_help_panel=SCENE)
    ] = False,
    tokens: Annotated[str, typer.Option(help="pooled: views only. all: every token too (large).")] = "pooled",
    captured_calls: Annotated[int, typer.Option(help="Inferences captured per episode.")] = 1,
    execute: Annotated[
        int | None, typer.Option(help="Actions executed per inference; default the model's.")
    ] = None,
    capture_only: Annotated[
        bool,
        typer.Option(
            "--no-act", help="Capture the first inference of each episode; do not act (no success rate)."
        ),
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of cube places and policy noise.")] = 0,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1 …")] = "cpu",
    dtype: Annotated[str | None, typer.Option(help="float32 or bfloat16; default the checkpoint's.")] = None,
    codec: Annotated[str, typer.Option(help="zstd, fast or none.")] = "zstd",
    video: Annotated[str, typer.Option(help="GIF of the first episode, of all, or none.")] = "none",
    frames: Annotated[
        str, typer.Option(help="ends: thumbnails of first and last frames, for the report. none: no pictures.")
    ] = "ends",
    batch: Annotated[
        str,
        typer.Option(
            help="Observations per policy call; above 1, numbers repeat up to float rounding. auto: measure for "
            "some seconds, and choose --env-workers too."
        ),
    ] = "1",
    env_workers: Annotated[
        int | None, typer.Option(help="Processes that simulate and draw; default two per observation of a batch.")
    ] = None,
    workers: Annotated[
        int, typer.Option(help="Processes with a model each, one per GPU; 0 for this process.")
    ] = 0,
    ray: Annotated[
        str | None, typer.Option(help="Work on this Ray cluster; auto: the one of this machine, or a new one.")
    ] = None,
    inference_limit: Annotated[
        float | None,
        typer.Option(help="Seconds after which a worker whose model hangs is ended; needs --workers."),
    ] = None,
    allow_mixed: Annotated[
        bool,
        typer.Option("--allow-mixed", help="Continue a run begun with other versions or on another device."),
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan and stop.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Start even if the disk looks too small.")] = False,
) -> None:
    """Let a model act in every episode and store its residual streams.

    The same command continues an interrupted run; other settings in the same folder are refused.
    """
    from probe_kit.extract import ExtractSettings, prepare
    from probe_kit.extract.protocols import scene_of
    from probe_kit.extract.store.locations.locate import locate
    from probe_kit.hooks.contract.options import read_pairs
    from probe_kit.suite.ladder import check_wordings

    asked = {
        "max_steps": max_steps,
        "tile_side": tile_side,
        "light_level": light_level,
        "rendering": rendering,
        "background": background,
        "picture_size": None if picture_size is None else read_size(picture_size),
        "epsilon": epsilon,
        "arm": arm,
        "arm_urdf": arm_urdf,
        "start_grasped": start_grasped or None,
        "early_stop": early_stop or None,
    }
    changes = {name: value for name, value in asked.items() if value is not None}
    settings = ExtractSettings(
        model=model,
        checkpoint=checkpoint,
        random_weights=random_weights,
        weights_seed=weights_seed,
        options=read_pairs(model_option or []),
        label=label,
        suite=suite,
        categories=split(categories),
        items=items,
        wordings=None if wordings is None else check_wordings(split(wordings) or ()),
        protocol=protocol,
        scene=scene_of(model, protocol, scene, **changes),
        seed=seed,
        tokens=tokens,
        captured_calls=captured_calls,
        execute=execute,
        capture_only=capture_only,
        codec=codec,
        device=device,
        dtype=dtype,
        video=video,
        frames=frames,
        batch=1 if batch == "auto" else read_batch(batch),
        calibrate=batch == "auto",
        env_workers=env_workers,
        workers=workers,
        ray=ray,
        inference_limit=inference_limit,
        allow_mixed=allow_mixed,
    )
    with err.status("loading suite and model"):
        extraction = prepare(settings, out_folder)
    location = locate(out_folder or Path("runs") / extraction.default_name())
    print_plan(extraction, location)
    if dry_run:
        return
    with progress() as bar:
        run = extraction.run(location, force=force, progress=counter(bar, "episodes"))
    _print_outcomes(run)


def read_size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT in pixels. Raises UsageError for another form."""
    width, height = map(whole_number, text.partition("x")[::2])
    if width is None or height is None:
        raise UsageError(f"picture size {text!r} is not WIDTHxHEIGHT, such as 224x224")
    return width, height


def read_batch(text: str) -> int:
    """A number of observations. Raises UsageError for anything else."""
    number = whole_number(text)
    if number is None:
        raise UsageError(f"--batch {text!r} is neither a whole number nor auto")
    return number


def print_plan(extraction: "Extraction", location: "Location") -> None:
    """What is going to be run, how much it stores and where."""
    from rich.table import Table

    from probe_kit.extract.needs import space_needed
    from probe_kit.extract.store.locations.disk import in_units

    plan, identity, free = extraction.plan, extraction.identity(), location.free_bytes()
    needed = in_units(sum(space_needed(plan, extraction.settings).values()))
    weights = (identity["weights_sha256"] or "scripted")[:12]
    rows = {
        "model": f"{identity['model']}  weights {weights}" + ("  RANDOM" if identity["random_weights"] else ""),
        **_protocol_row(identity),
        "suite": plan.suite.identity,
        "categories": ", ".join(plan.suite.categories),
        "scene": _describe_scene(extraction.settings.scene),
        "episodes": f"{len(plan.episodes)} ({len(plan.suite.items)} items in both layouts)",
        **({} if plan.skipped is None else {"wordings": _describe_wordings(plan.skipped)}),
        "streams": "; ".join(_describe(s) for s in plan.streams) or "none",
        **(
            {"acts": "no: only captured, once per episode; no success rate"}
            if identity.get("capture_only")
            else {}
        ),
        "activations": f"{plan.sites} sites, {plan.bytes / 1e6:,.1f} MB before compression",
        "disk": f"up to {needed} with columns, probes and report; "
        + ("no bound" if free is None else f"{in_units(free)} free"),
        **_pace_row(extraction),
        "run": str(location),
    }
    table = Table(show_header=False, title="plan", box=None)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")  # a path that is cut off is no path
    for name, value in rows.items():
        table.add_row(marked("[dim]{}[/]", name), value)
    err.print(table)


def _describe_scene(scene: "SceneSpec") -> str:
    """The preset, and how long an episode may last."""
    early = ", less once the cube was released and rests" if scene.early_stop else ""
    return f"{scene.name}, at most {scene.max_steps} actions{early}"


def _describe_wordings(skipped: "Mapping[Wording, int]") -> str:
    """Their names, and how many items are left out of each."""
    return ", ".join(
        f"{name} ({count} items have none: skipped)" if count else name for name, count in skipped.items()
    )


def _pace_row(extraction: "Extraction") -> dict[str, str]:
    """What a calibration chose; nothing where batch and processes were given."""
    if extraction.calibration is not None:
        return {"pace": extraction.calibration.words}
    return {"pace": "batch auto: every worker chooses its own"} if extraction.settings.calibrate else {}


def _protocol_row(identity: dict[str, Any]) -> dict[str, str]:
    if "protocol" not in identity:
        return {}
    said = identity["protocol"]
    changed = ", ".join(f"{name}={run} instead of {was}" for name, (was, run) in said["deviations"].items())
    return {"protocol": said["name"] + (f", but {changed}" if changed else ", as released")}


def _describe(stored: Any) -> str:
    steps = f" x {stored.iterations} iterations" if stored.iterations else ""
    return f"{stored.name} {stored.layers} layers{steps} x {stored.tokens} tokens x {stored.width}"


def _print_outcomes(run: "Run") -> None:
    counts = run.episodes["outcome"].value_counts()
    text = ", ".join(f"{name} {count}" for name, count in counts.items())
    say(f"{len(run.episodes)} episodes: {text}")
    step = "retention" if not run.streams else "train"
    say(marked("next: [bold]probe-kit {} {}[/]", step, run.location))
    out.print(str(run.location), soft_wrap=True)
