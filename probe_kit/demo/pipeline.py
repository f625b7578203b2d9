"""The whole pipeline on the embedded policy: what `probe-kit demo` runs."""

import shlex
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.text import Text

from probe_kit._system.drafts import write_whole
from probe_kit._terminal.console import marked
from probe_kit.demo.organisms import TRAINED, VLM, Finding, NamedProgress, answered, compare, probed
from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.displays import layer_curve
from probe_kit.retention.report import write_report
from probe_kit.runs import Run
from probe_kit.runs.layout import VIDEOS
from probe_kit.suite import Suite, build_suite


@dataclass(frozen=True)
class Size:
    """The extent of a demo. items: per category; permutations: of the labels, for the probes."""

    items: Mapping[str, int]
    permutations: int


QUICK = Size({"color": 12, "state": 24, "counting": 12}, permutations=100)
"""A category that is used, one that is known and not used, and one that was never trained.

*Not used* is shown with 11 independent groups of items or more, so that State has twice as many items.
"""
FULL = Size(dict.fromkeys(("color", "shape", "state", "counting"), 24), permutations=200)
"""What organisms are compared on."""


@dataclass(frozen=True)
class Demo:
    """The products of the demo. vlm_run: the run of the VLM. table: of both runs."""

    folder: Path
    vlm_run: Run
    run: Run
    table: RetentionTable

    def next_steps(self) -> Text:
        """Return where to look, and what to try."""
        lines: list[str | Text] = [
            marked("[bold]Look at[/] {}  everything on one page, in a browser", self.folder / "report.html"),
            f"        {self.folder / 'layer_curves.png'}  where the answer can be read, layer by layer",
            f"        {self.folder / 'episode.gif'}  what one episode looks like",
            f"        {self.folder / 'table.md'}  every table",
            f"        {self.run.path}  the run: open_run({str(self.run.path)!r}), plain zarr.open or xarray",
            marked("[bold]Try[/]     probe-kit suite show            the questions"),
            "        probe-kit extract --model expert --items 4    a policy that knows the answers",
            "        probe-kit models                the models that can be probed",
        ]
        if self.run.random_weights:
            warning = "[bold yellow]The policy has random weights:[/] expect SR near 0 and no signal."
            lines.insert(0, marked(warning))
        return Text("\n").join(line if isinstance(line, Text) else Text(line) for line in lines)

    def viewer(self) -> Text:
        """Return one line: the command that shows both runs episode by episode."""
        runs = (shlex.quote(str(run.path)) for run in (self.run, self.vlm_run))
        return marked("[bold]Open[/]    probe-kit view {} {}", *runs)


def compare_organisms(folder: Path, stage: NamedProgress) -> list[Finding]:
    """Put the questions of `FULL` to policies of which the truth is known; see `probe_kit.demo.organisms`."""
    return compare(_questions(folder, FULL, stage), folder, FULL.permutations, stage)


def _questions(folder: Path, size: Size, stage: NamedProgress) -> Suite:
    return build_suite(folder / "suite", tuple(size.items), size.items, progress=stage("drawing questions"))


def run_demo(folder: Path, stage: NamedProgress, size: Size = QUICK) -> Demo:
    """Suite, answers, episodes, probes, table, figure, film and report in `folder`; called again, it continues.

    stage: gives a progress callback (done, total, …) for a stage of this name.
    """
    suite = _questions(folder, size, stage)
    vlm_run = answered(VLM, suite, folder, stage)
    run, results = probed(TRAINED, suite, folder, size.permutations, stage)
    table = retention_table([vlm_run, run])
    layer_curve(results).savefig(folder / "layer_curves.png")
    write_whole(folder / "table.md", table.to_markdown())
    write_report([vlm_run, run], folder / "report.html", table)
    film = next((run.path / VIDEOS).glob("*.gif"))
    shutil.copyfile(film, folder / "episode.gif")
    return Demo(folder, vlm_run, run, table)
