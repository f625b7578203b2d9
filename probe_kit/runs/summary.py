"""A run in one line and as a notebook table."""

from pathlib import Path

from probe_kit._terminal.notebook import facts_html
from probe_kit.hooks.contract.card import streams_text
from probe_kit.runs.layout import CAPTURE_ONLY
from probe_kit.runs.reader import RunReader


def run_text(run: RunReader) -> str:
    """One line: model, suite, how much is there, where."""
    random = ", RANDOM WEIGHTS" if run.random_weights else ""
    random += ", CAPTURE ONLY (it did not act)" if CAPTURE_ONLY in _outcomes(run) else ""
    return f"<Run {run.label}{random} on {run.suite}: {_episodes(run)}, at {run.location}>"


def run_html(run: RunReader) -> str:
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


def _episodes(run: RunReader) -> str:
    committed = len(run.episodes)
    return f"{committed} episodes" if committed == run.planned else f"{committed} of {run.planned} episodes"


def _outcomes(run: RunReader) -> dict[str, int]:
    if run.episodes.empty:
        return {}
    return {str(name): int(count) for name, count in run.episodes["outcome"].value_counts().items()}
