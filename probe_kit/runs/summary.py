"""A run in one line and as a notebook table; and the runs that a folder contains."""

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from probe_kit._system.counting import counted
from probe_kit._terminal.notebook import facts_html
from probe_kit.hooks.contract.summary import streams_text
from probe_kit.runs.layout import CAPTURE_ONLY
from probe_kit.runs.run_folders import runs_in

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.hooks.contract.sites import Stream
    from probe_kit.runs.store import Location


class DescribedRun(Protocol):
    """Name, origin and content of a run."""

    @property
    def location(self) -> "Location":
        """The place of the run; probe results go to `probes` there. For a folder: `locate(folder)`."""

    @property
    def model(self) -> str:
        """Name of the model."""

    @property
    def label(self) -> str:
        """Name of the run in tables and legends; two runs of one model differ in it."""

    @property
    def weights_sha256(self) -> str | None:
        """Hash of the weights that ran; None for a policy without weights."""

    @property
    def random_weights(self) -> bool:
        """Whether the weights are random; marked in every table and figure."""

    @property
    def suite(self) -> str:
        """Identity of the suite, `name@version#hash`."""

    @property
    def episodes(self) -> "pd.DataFrame":
        """One row per finished episode, with at least `episode_id`, `item_id`, `category`, `group_id`,
        `layout`, `side_correct`, `outcome` and `side_placed`.
        """

    @property
    def streams(self) -> "Mapping[str, Stream]":
        """Captured streams by name; empty for a policy without activations."""


class Summarised(DescribedRun, Protocol):
    """A run with a plan; see `Run`."""

    @property
    def planned(self) -> int:
        """Episodes of the plan."""


def run_text(run: Summarised) -> str:
    """One line: model, suite, how much is there, where."""
    random = ", RANDOM WEIGHTS" if run.random_weights else ""
    random += ", CAPTURE ONLY (it did not act)" if CAPTURE_ONLY in _outcomes(run) else ""
    return f"<Run {run.label}{random} on {run.suite}: {_episodes(run)}, at {run.location}>"


def run_html(run: Summarised) -> str:
    """Describe the run, how it went, and its folder."""
    weights = "scripted, no weights" if run.weights_sha256 is None else f"sha256 {run.weights_sha256[:12]}"
    facts = {
        "suite": run.suite,
        "weights": f"RANDOM ({weights})" if run.random_weights else weights,
        "episodes": _episodes(run),
        "outcomes": ", ".join(f"{name} {count}" for name, count in _outcomes(run).items()),
        "streams": streams_text(run.streams.values()),
        "at": run.location.name if Path(str(run.location)).is_absolute() else str(run.location),
    }
    return facts_html(f"Run of {run.label}", facts, "run.episodes is the table, run.column(site) one site of it")


def _episodes(run: Summarised) -> str:
    committed = len(run.episodes)
    return f"{committed} episodes" if committed == run.planned else f"{committed} of {run.planned} episodes"


def _outcomes(run: Summarised) -> dict[str, int]:
    if run.episodes.empty:
        return {}
    return {str(name): int(count) for name, count in run.episodes["outcome"].value_counts().items()}


MOST = 12
"""Runs of a folder that a message names."""


def what_to_open(address: str) -> str:
    """Advise what to do where there is no run: open one inside, one of nearly that name, or make one."""
    folder = Path(address).expanduser()
    if "://" not in address:
        if inside := runs_in(folder):
            more = f" and {len(inside) - MOST} more" if len(inside) > MOST else ""
            return f"It holds {counted(len(inside), 'run')}: {', '.join(map(str, inside[:MOST]))}{more}"
        neighbours = {path.name: path for path in runs_in(folder.parent, deep=False)}
        if near := get_close_matches(folder.name, neighbours, n=1):
            return f"Did you mean {neighbours[near[0]]}?"
    return "Make one with `probe-kit extract`"
