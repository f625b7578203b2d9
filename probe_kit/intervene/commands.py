"""`probe-kit intervene`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe_kit._terminal.console import counter, marked, out, print_json_text, print_text, progress, say, split
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from probe_kit.extract import Run
    from probe_kit.intervene.replay.conditions import Intervention
    from probe_kit.intervene.results.results import InterventionResult

KINDS = ("follow", "words", "interchange", "steer", "closed-loop", "erase", "attention")
INSIDE = "Inside the network (interchange, steer, closed-loop, erase, attention)"
_FORMATS = ("table", "json", "csv")


def intervene(
    run: Annotated[str, typer.Argument(help="Run folder or URL.")],
    kind: Annotated[
        str,
        typer.Option(
            help="follow: with the two pictures exchanged, does the action change sides? words: before the "
            "same pictures, asked for the other one? interchange: where "
            "inside does that pass? steer: a direction added, beside matched controls. closed-loop: the best "
            "place of an interchange and its controls, with every episode played again. erase: what can be read "
            "linearly taken away per token, beside random subspaces; says less than an exchange. attention: how "
            "much of it what acts pays to pictures, tiles, words and state; describes, and changes nothing."
        ),
    ] = "follow",
    categories: Annotated[str | None, typer.Option(help="Comma-separated; default all of the run.")] = None,
    items: Annotated[int | None, typer.Option(help="Items per category, the first ones; default all.")] = None,
    sites: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated: backbone.*, backbone.02, expert.03@0-4, memory.*; default backbone.*. "
            "Closed loop: default the last place, of each category, that the newest interchange located.",
            rich_help_panel=INSIDE,
        ),
    ] = None,
    roles: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated: all, image, image.left, image.right, language, state, action; default "
            "all,image,language. Steer: the "
            "one whose tokens are moved. Closed loop: with --sites, default all. Erase: default image. Attention: "
            "default all that the family has.",
            rich_help_panel=INSIDE,
        ),
    ] = None,
    direction: Annotated[
        str | None,
        typer.Option(
            help="mean-difference or probe, of the mean over tokens: interchange along it only; steer along it "
            "(the first is default). mean-difference:K: interchange along K directions found token by token. "
            "Closed loop: along it as well (default mean-difference:1), or none. Erase: leace (default), "
            "mean-difference:K or inlp:K, K directions per token.",
            rich_help_panel=INSIDE,
        ),
    ] = None,
    controls: Annotated[
        int | None,
        typer.Option(
            help="Matched random directions beside it; default 5, closed loop 1.",
            min=0,
            max=100,
            rich_help_panel=INSIDE,
        ),
    ] = None,
    coefficients: Annotated[
        str | None,
        typer.Option(help="Steer: in half gaps of the class means; default 1,2,4.", rich_help_panel=INSIDE),
    ] = None,
    target_side: Annotated[
        str | None, typer.Option(help="Steer: wrong (default), correct, left or right.", rich_help_panel=INSIDE)
    ] = None,
    readout: Annotated[
        str,
        typer.Option(
            help="chunk: what the first inference would do. shadow: what every inference of the unedited episode "
            "would, for policies whose inference is one action (OpenVLA, SpatialVLA, Magma).",
        ),
    ] = "first-chunk",
    seed: Annotated[int, typer.Option(help="Of controls and folds of directions.", rich_help_panel=INSIDE)] = 0,
    suite: Annotated[
        Path | None, typer.Option(help="Folder of the run's suite; default the embedded one.")
    ] = None,
    checkpoint: Annotated[
        str | None, typer.Option(help="Folder or hub id the run's policy came from; default the family's.")
    ] = None,
    model_option: Annotated[
        list[str] | None, typer.Option("--model-option", "-M", help="NAME=VALUE, as given to extract; may repeat.")
    ] = None,
    weights_seed: Annotated[int, typer.Option(help="Of a random twin's weights, as given to extract.")] = 0,
    scene_file: Annotated[
        list[str] | None,
        typer.Option(help="background=FILE or arm_urdf=FILE, if the scene was made with one; may repeat."),
    ] = None,
    wording: Annotated[
        str | None, typer.Option(help="Of a run with several wordings: the one to replay; default its first.")
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1 …")] = "cpu",
    style: Annotated[str, typer.Option("--format", help="table, json or csv.")] = "table",
    partial: Annotated[bool, typer.Option("--partial", help="Accept a run that is not finished.")] = False,
) -> None:
    """Change what the policy sees, and nothing else: is what can be read also used?

    Replays the first inference of every episode, or with --kind closed-loop all of it, and stores what came of it
    in the run, where `retention` shows what is followed.
    The same command continues what was interrupted, and reads back what is there.
    """
    from probe_kit.extract import open_run
    from probe_kit.hooks.contract.options import read_pairs
    from probe_kit.intervene import ReplaySource, run_intervention
    from probe_kit.intervene.runner import check_unsupported
    from probe_kit.intervene.store.answers import is_stored
    from probe_kit.intervene.store.settings import check_unfit, key_of, readout_of, settings_of

    if kind not in KINDS:
        raise UsageError(f"unknown kind {kind!r}; expected one of {', '.join(KINDS)}")
    if style not in _FORMATS:
        raise UsageError(f"unknown format {style!r}; expected one of {', '.join(_FORMATS)}")
    opened = open_run(run, allow_partial=partial).in_wording(wording)
    intervention = _asked(
        opened,
        kind,
        {"categories": split(categories), "items": items, "readout": readout_of(readout)},
        {"sites": split(sites), "roles": split(roles), "direction": direction, "controls": controls,
         "doses": None if coefficients is None else tuple(map(_dose, split(coefficients) or ())), "toward": target_side,
         "seed": seed or None},
    )  # fmt: skip
    check_unfit(opened)
    check_unsupported(opened, intervention)
    intervention.categories_in(opened)
    files = {name: Path(str(place)) for name, place in read_pairs(scene_file or []).items()}
    source = ReplaySource(suite, checkpoint, read_pairs(model_option or []), weights_seed, device, files)
    is_there = is_stored(opened.location, key_of(settings_of(intervention, opened)))
    with progress() as bar:
        on_fit_progress = counter(bar, "items learnt from") if intervention.fits_first else None
        replayed = counter(bar, "items replayed")
        effects = run_intervention(
            opened, intervention, source, progress=replayed, on_fit_progress=on_fit_progress
        )
    _show(effects, style)
    if is_there:
        say("read back: it was stored, so that no policy, suite or device was looked for")
    say(marked("stored as {}; next: [bold]probe-kit retention {}[/]", effects.key, run))


_OPTIONS = {
    "follow": (),
    "words": (),
    "interchange": ("sites", "roles", "direction", "controls", "seed"),
    "steer": ("sites", "roles", "direction", "controls", "doses", "toward", "seed"),
    "closed-loop": ("sites", "roles", "direction", "controls", "seed"),
    "erase": ("sites", "roles", "direction", "controls", "seed"),
    "attention": ("roles",),
}


def _asked(run: "Run", kind: str, common: dict[str, Any], inside: dict[str, Any]) -> "Intervention":
    """What was asked. Raises UsageError for an option that this kind does not have."""
    from probe_kit.intervene import AttentionReadout, ImageSwap, InstructionSwap, Interchange, Steering

    given = {name: value for name, value in inside.items() if value is not None}
    if meaningless := [name for name in given if name not in _OPTIONS[kind]]:
        raise UsageError(
            f"--{meaningless[0]} means nothing to --kind {kind}; leave it out, or choose another kind"
        )
    if kind in ("follow", "words"):
        return InstructionSwap(**common) if kind == "words" else ImageSwap(**common)
    if kind == "attention":
        return AttentionReadout(**common, **given)
    if kind == "closed-loop":
        return _closed_loop(run, common, given)
    if kind == "interchange":
        controls = given.pop("controls", 5 if "direction" in given else 0)
        return Interchange(**common, **given, controls=controls)
    if kind == "erase":
        return _erase(common, given)
    named = given.pop("roles", ())
    if "sites" not in given or len(named) != 1:
        raise UsageError(
            "--kind steer needs --sites and one of --roles, such as --sites backbone.02 --roles image"
        )
    return Steering(**common, **given, role=named[0])


def _erase(common: dict[str, Any], given: dict[str, Any]) -> "Intervention":
    from probe_kit.intervene import ConceptErasure

    if "sites" not in given:
        raise UsageError("--kind erase needs --sites, such as --sites backbone.02")
    return ConceptErasure(**common, **given | ({"method": given.pop("direction")} if "direction" in given else {}))


def _closed_loop(run: "Run", common: dict[str, Any], given: dict[str, Any]) -> "Intervention":
    from probe_kit.intervene import ClosedLoop, ImageSwap, best_patch_targets

    sites, roles = given.pop("sites", None), given.pop("roles", None)
    if roles and not sites:
        raise UsageError("--roles of a closed loop go with --sites; leave both out for the best stored place")
    if given.get("direction") == "none":
        given.setdefault("controls", 0)
    if sites:
        cells = tuple(f"{site}|{role}" for site in sites for role in roles or ("all",))
    else:
        cells = best_patch_targets(run, ImageSwap(**common).categories_in(run))
    return ClosedLoop(**common, **given, cells=cells)


def _dose(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"{text!r} is no dose; expected numbers of half gaps, such as 1,2,4") from None


def _show(effects: "InterventionResult", style: str) -> None:
    if style == "json":
        print_json_text(effects.to_json())
    elif style == "csv":
        print_text(effects.to_csv())
    else:
        out.print(effects.to_rich())
    for note in effects.notes:
        say(marked("[yellow]note:[/] {}", note))
