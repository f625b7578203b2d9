"""`probe-kit ask`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit._terminal import options as common
from probe_kit._terminal.console import counter, err, marked, out, progress, say
from probe_kit._terminal.field_options import command_with
from probe_kit.extract import command_options as start
from probe_kit.extract.commands import print_input_notes, print_plan, print_sufficiency
from probe_kit.extract.config_files import read_config
from probe_kit.extract.settings import AskSettings
from probe_kit.extract.sources.scene import SceneOptions

if TYPE_CHECKING:
    from probe_kit.runs import Run

OWN_SCENE = frozenset(SceneOptions.model_fields) - {"scene"} | {"wordings"}
"""Fields of a scene that questions leave as they are."""


@command_with(*AskSettings.option_models(), offers=lambda name: name not in OWN_SCENE)
def ask(
    typed: Mapping[str, Any],
    prompt: start.Prompts = None,
    picture_size: start.PictureSizes = None,
    out_folder: start.AskOutFolder = None,
    config: start.ConfigFile = None,
    dry_run: common.DryRun = False,
    force: common.Force = False,
) -> None:
    """Ask a vision-language model about the first frame of every episode.

    Makes one run per prompt and picture size. Use the --suite, --protocol, --scene and --seed of the policy runs
    to compare with. Every question is asked in both orders of the options. Answers are read from the text and from
    the logits of the options. Compare with policies by `probe-kit retention ASKED… ACTED…`, also with
    --compare stages. Recordings, environments and pictures have no objects: their instruction is the question, and
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
    """Print how each run went, what to look at, and what to do next."""
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
        say(marked(f"next: [bold]probe-kit {step}[/]", runs[0].location))
        return
    places = " ".join(str(run.location) for run in runs)
    say(marked("next: [bold]probe-kit retention {}[/]  add policy runs of the suite", places))
