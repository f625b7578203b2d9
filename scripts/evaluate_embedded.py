"""What the embedded models know and do, with intervals: `python scripts/evaluate_embedded.py OUT`.

Asks `vlm-tiny` the prompts of `probe-kit ask` about the first frames of a scene, and with `--policy` has
`pi0-tiny` act in it; both on the embedded suite, whose pictures no training has seen. Finished runs are reused.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from probe_kit.console import counter, progress
from probe_kit.env import SceneSpec
from probe_kit.extract import AskSettings, ExtractSettings, Run, ask_run, extract_run
from probe_kit.extract.asking.templates import TEMPLATES
from probe_kit.organisms import READER, TRAINED, verdict
from probe_kit.retention import RetentionRow, retention
from probe_kit.retention.rows import MEAN
from probe_kit.suite import Suite, build_suite

CATEGORIES = ("color", "shape", "state", "traffic", "counting")
HEADING = ("run", "category", "N", "SR % [95 %]", "Δ by items", "oob or unreadable %", "expected", "measured")


def main(
    out: Annotated[Path, typer.Argument(help="Folder for suite and runs.")],
    items: Annotated[int, typer.Option(help="Per category; each is played in two layouts.")] = 150,
    prompts: Annotated[str, typer.Option(help="Comma-separated; empty to ask nothing.")] = "p1,p2,seen",
    scene: Annotated[str, typer.Option(help="Preset.")] = "bridge",
    suite_version: Annotated[int, typer.Option(help="Of the embedded suite: 1 or 2.")] = 1,
    policy: Annotated[bool, typer.Option("--policy", help="Have the policy act too.")] = False,
) -> None:
    """Ask, act, print."""
    with progress() as bar:
        suite = build_suite(
            out / f"suite-{suite_version}",
            CATEGORIES,
            items,
            version=suite_version,
            progress=counter(bar, "suite"),
        )
        runs = [_asked(out, suite, scene, prompt, counter(bar, prompt)) for prompt in prompts.split(",") if prompt]
        if policy:
            settings = ExtractSettings(TRAINED.model, suite=suite.folder, scene=SceneSpec.preset(scene))
            runs.append(extract_run(settings, _folder(out, suite, scene, "acted"), counter(bar, "episodes")))
    rows = [row for run in runs for row in retention([run]).rows if row.category != MEAN]
    for cells in (HEADING, ["---"] * len(HEADING), *map(_cells, rows)):
        typer.echo(f"| {' | '.join(cells)} |")


def _asked(out: Path, suite: Suite, scene: str, prompt: str, count: Callable[..., None]) -> Run:
    settings = AskSettings(
        READER.model, suite=suite.folder, scene=SceneSpec.preset(scene), prompt=TEMPLATES[prompt], frames="none"
    )
    return ask_run(settings, _folder(out, suite, scene, prompt), count)


def _folder(out: Path, suite: Suite, scene: str, name: str) -> Path:
    return out / f"{name}-{scene}-{suite.version}-{suite.content_sha256[:8]}"


def _cells(row: RetentionRow) -> tuple[str, ...]:
    whose = TRAINED if row.kind == "acts" else READER
    low, high = row.sr_ci
    return (
        row.label or row.model,
        row.category,
        str(row.n_episodes),
        f"{100 * row.sr:.1f} [{100 * low:.1f}, {100 * high:.1f}]",
        f"{100 * row.delta_regime:.1f}",
        f"{100 * row.p_oob:.1f}",
        whose.expected(row.category),
        verdict(row) if row.kind == "asks" else str(row.regime),
    )


if __name__ == "__main__":
    typer.run(main)
