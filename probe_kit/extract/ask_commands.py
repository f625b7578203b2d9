"""`probe-kit ask`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit._terminal.console import counter, err, marked, out, progress, say, split
from probe_kit.errors import UsageError
from probe_kit.extract.commands import print_plan, read_size

if TYPE_CHECKING:
    from probe_kit.extract import Run
    from probe_kit.extract.settings import AskSettings

CONTROLS = "Controls"
MACHINE = "How fast it comes (changes no number)"


def ask(
    model: Annotated[str, typer.Option(help="A model of `probe-kit models` that answers.")],
    prompt: Annotated[
        str,
        typer.Option(
            help="Comma-separated: seen, p1, p2 (the paper's), or text files with {object}, and {A} and {B} for "
            "the sides."
        ),
    ] = "p1,p2,seen",
    picture_size: Annotated[
        str, typer.Option(help="Comma-separated, width first; the paper's are 224x224,560x480.")
    ] = "224x224",
    out_folder: Annotated[
        str | None,
        typer.Option("--out", help="Folder or URL; runs lie in it as <prompt>-<size>. Default runs/ask-<model>-…"),
    ] = None,
    checkpoint: Annotated[str | None, typer.Option(help="Folder or hub id; default the family's.")] = None,
    model_option: Annotated[
        list[str] | None,
        typer.Option(
            "--model-option",
            "-M",
            metavar="KEY=VALUE",
            help="An option of this model; `probe-kit models NAME` lists them. May be repeated.",
        ),
    ] = None,
    label: Annotated[str | None, typer.Option(help="What tables call these runs; prompt and size follow.")] = None,
    suite: Annotated[Path | None, typer.Option(help="Suite folder; default the embedded suite.")] = None,
    categories: Annotated[str | None, typer.Option(help="Comma-separated; default all of the suite.")] = None,
    items: Annotated[int | None, typer.Option(help="Items per category, even; default all.")] = None,
    scene: Annotated[
        str | None,
        typer.Option(help="Scene preset, as of the run to compare with; default the one the model was made for."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of cube places, as of the run to compare with.")] = 0,
    tokens: Annotated[
        str,
        typer.Option(help="none: answers only. pooled: also views of the streams, for probes. all: every token."),
    ] = "none",
    picture: Annotated[
        str,
        typer.Option(
            help="frame: the first frame. side-by-side: the two pictures on grey. none: words alone; accuracy is "
            "then one half, or the suite leaks.",
            rich_help_panel=CONTROLS,
        ),
    ] = "frame",
    asked: Annotated[
        str,
        typer.Option(
            "--ask",
            help="target; distractor: what the other picture shows; absent: what neither shows (with seen; right: "
            "no).",
            rich_help_panel=CONTROLS,
        ),
    ] = "target",
    random_weights: Annotated[
        bool, typer.Option("--random-weights", help="Ask an untrained twin.", rich_help_panel=CONTROLS)
    ] = False,
    weights_seed: Annotated[int, typer.Option(help="Seed of --random-weights.", rich_help_panel=CONTROLS)] = 0,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1 …")] = "cpu",
    dtype: Annotated[str | None, typer.Option(help="float32 or bfloat16; default the checkpoint's.")] = None,
    batch: Annotated[
        int,
        typer.Option(
            help="Questions per call; above 1, numbers repeat up to float rounding.", rich_help_panel=MACHINE
        ),
    ] = 1,
    env_workers: Annotated[
        int | None, typer.Option(help="Processes that draw; default two per question.", rich_help_panel=MACHINE)
    ] = None,
    workers: Annotated[
        int, typer.Option(help="Processes with a model each, one per GPU.", rich_help_panel=MACHINE)
    ] = 0,
    ray: Annotated[
        str | None, typer.Option(help="Work on this Ray cluster; auto: find one.", rich_help_panel=MACHINE)
    ] = None,
    frames: Annotated[
        str,
        typer.Option(help="ends: a thumbnail of every first frame. none: no pictures.", rich_help_panel=MACHINE),
    ] = "ends",
    allow_mixed: Annotated[
        bool,
        typer.Option("--allow-mixed", help="Continue a run begun with other versions or on another device."),
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plans and stop.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Start even if the disk looks too small.")] = False,
) -> None:
    """Ask a vision-language model about the first frame of every episode, in words.

    One run per prompt and picture size, in the scenes that `probe-kit extract` plays with the same --suite,
    --scene and --seed. Every question is asked twice, with the options exchanged, and answered twice: in text, and
    as a choice between the options' logits. Runs are read like any other: `probe-kit retention ASKED… ACTED…` puts
    both in one table, with --vlm-vla it tests the difference, and `probe-kit stages` says what is known and not
    used.

    The same command continues interrupted runs; other settings in the same folder are refused.
    """
    from probe_kit.extract.extraction import prepare_asks
    from probe_kit.extract.protocols import scene_of
    from probe_kit.extract.settings import AskSettings
    from probe_kit.extract.store.locations.locate import locate
    from probe_kit.extract.vqa.templates import find_template
    from probe_kit.hooks.contract.options import read_pairs

    templates = [find_template(name) for name in _several(prompt, "--prompt")]
    sizes = [read_size(text) for text in _several(picture_size, "--picture-size")]
    shared = {
        "checkpoint": checkpoint,
        "random_weights": random_weights,
        "weights_seed": weights_seed,
        "options": read_pairs(model_option or []),
        "label": label,
        "suite": suite,
        "categories": split(categories),
        "items": items,
        "seed": seed,
        "tokens": tokens,
        "device": device,
        "dtype": dtype,
        "frames": frames,
        "batch": batch,
        "env_workers": env_workers,
        "workers": workers,
        "ray": ray,
        "allow_mixed": allow_mixed,
        "picture": picture,
        "asked": asked,
    }
    wanted = [
        AskSettings(model, prompt=template, scene=scene_of(model, None, scene, picture_size=size), **shared)  # type: ignore[arg-type]
        for template in templates
        for size in sizes
    ]
    _refuse_doubles(wanted)
    places = [None if out_folder is None else f"{out_folder.rstrip('/')}/{own.short_name}" for own in wanted]
    runs: list[Run] = []
    prepared = prepare_asks(wanted, places)
    for place in places:
        with err.status("loading suite and model"):
            extraction = next(prepared)
        location = locate(place or Path("runs") / extraction.default_name())
        print_plan(extraction, location)
        if not dry_run:
            with progress() as bar:
                runs.append(extraction.run(location, force=force, progress=counter(bar, "questions")))
    if not dry_run:
        _print_answers(runs)


def _several(text: str, option: str) -> tuple[str, ...]:
    parts = split(text) or ()
    if not parts:
        raise UsageError(f"{option} is empty; name at least one")
    return parts


def _refuse_doubles(wanted: "Sequence[AskSettings]") -> None:
    names = [own.short_name for own in wanted]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise UsageError(
            f"{', '.join(twice)} is asked for twice; give every prompt and size once, and files own names"
        )


def _print_answers(runs: "Sequence[Run]") -> None:
    """How each run went, what to look at, and what to do next."""
    for run in runs:
        episodes = run.episodes
        counts = ", ".join(f"{name} {count}" for name, count in episodes["outcome"].value_counts().items())
        unread = episodes.loc[episodes["outcome"] == "oob", "parse"].value_counts()
        reasons = f" ({', '.join(f'{name} {count}' for name, count in unread.items())})" if len(unread) else ""
        mass = float(episodes["option_mass"].mean())
        say(f"{run.label}: {counts}{reasons}; option mass {mass:.2f}")
        out.print(str(run.location), soft_wrap=True)
    places = " ".join(str(run.location) for run in runs)
    say(marked("next: [bold]probe-kit retention {}[/], with policy runs behind", places))
