"""What the embedded models know and do, with intervals: `python scripts/evaluate_embedded.py OUT`.

Has `pi0-tiny` act and asks `vlm-tiny` the prompts of `probe-kit ask`, on the embedded suite, whose pictures no
training has seen. Episodes are judged by two rules. Finished runs are reused.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from probe_kit._terminal.console import counter, progress
from probe_kit.demo.pipeline import TRAINED, VLM
from probe_kit.env import SceneSpec
from probe_kit.extract import AskSettings, ExtractSettings, ask_run, extract_run
from probe_kit.extract.prompts import TEMPLATES
from probe_kit.retention import RetentionRow, retention_table
from probe_kit.retention.columns.text import verdict
from probe_kit.retention.rows.row import MEAN
from probe_kit.runs import Run
from probe_kit.suite import Suite, build_suite

CATEGORIES = ("color", "shape", "state", "traffic", "counting")
RULES = ("disc", "released-on-tile")
HEADING = (
    "run", "rule", "category", "N", "SR % [95 %]", "original / swapped", "wrong", "outside or unparsable",
    "Δ", "measured",
)  # fmt: skip


def main(
    out: Annotated[Path, typer.Argument(help="Folder for suite and runs.")],
    items: Annotated[int, typer.Option(help="Per category; each is played in two layouts.")] = 150,
    prompts: Annotated[str, typer.Option(help="Comma-separated; empty to ask nothing.")] = "p1,p2,seen",
    categories: Annotated[str, typer.Option(help="Comma-separated.")] = ",".join(CATEGORIES),
    scene: Annotated[str, typer.Option(help="Preset.")] = "act2answer",
    early_stop: Annotated[bool, typer.Option(help="End an episode when the cube was released and lies.")] = True,
    suite_seed: Annotated[int, typer.Option(help="Of the embedded suite.")] = 0,
    checkpoint: Annotated[str | None, typer.Option(help="A policy instead of the embedded one.")] = None,
    policy: Annotated[bool, typer.Option(help="Have the policy act.")] = True,
) -> None:
    """Act, ask, print."""
    scene_spec = SceneSpec.preset(scene, early_stop=early_stop)
    with progress() as bar:
        suite = build_suite(
            out / f"suite-{suite_seed}",
            categories.split(","),
            items,
            seed=suite_seed,
            progress=counter(bar, "suite"),
        )
        runs = [
            _ask_scene(out, suite, scene_spec, prompt, counter(bar, prompt))
            for prompt in prompts.split(",")
            if prompt
        ]
        if policy:
            settings = ExtractSettings(
                TRAINED.model, checkpoint, suite=suite.folder, scene=scene_spec, frames="none"
            )
            name = "acted" if checkpoint is None else Path(checkpoint).name
            runs.append(extract_run(settings, _folder(out, suite, scene_spec, name), counter(bar, "episodes")))
    for cells in (HEADING, ["---"] * len(HEADING), *map(_cells, _rows(runs))):
        typer.echo(f"| {' | '.join(cells)} |")


def _rows(runs: list[Run]) -> list[RetentionRow]:
    """Of every run by itself; those that act by every rule."""
    judged = [(run, rule) for run in runs for rule in (RULES[:1] if run.ask else RULES)]
    return [row for run, rule in judged for row in retention_table([run], rule=rule).rows if row.category != MEAN]


def _ask_scene(out: Path, suite: Suite, scene: SceneSpec, prompt: str, count: Callable[..., None]) -> Run:
    settings = AskSettings(VLM.model, suite=suite.folder, scene=scene, prompt=TEMPLATES[prompt], frames="none")
    return ask_run(settings, _folder(out, suite, scene, prompt), count)


def _folder(out: Path, suite: Suite, scene: SceneSpec, name: str) -> Path:
    return out / f"{name}-{scene.name}-{suite.version}-{suite.content_sha256[:8]}"


def _cells(row: RetentionRow) -> tuple[str, ...]:
    acts = row.run.mode == "acts"
    low, high = row.success.ci
    layouts = (
        "–"
        if None in (row.success.sr_original, row.success.sr_swapped)
        else f"{_percent(row.success.sr_original)} / {_percent(row.success.sr_swapped)}"
    )
    return (
        row.run.label or row.run.model,
        row.rules.rule if acts else "–",
        row.category,
        str(row.success.n_episodes),
        f"{_percent(row.success.sr)} [{_percent(low)}, {_percent(high)}]",
        layouts,
        _percent(row.success.share_wrong),
        _percent(row.success.share_outside),
        _percent(row.success.chance_margin),
        str(row.success.regime) if acts else verdict(row),
    )


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f}"


if __name__ == "__main__":
    typer.run(main)
