"""Estimated disk space of a run before compression, including probes, figures and report."""

from probe_kit.extract.plan import Plan
from probe_kit.extract.settings import RunSettings

EPISODE = 40_000
"""Bytes of an episode's commit, trajectory and files of the file system (measured: 12 to 30 kB)."""
THUMBNAILS = 15_000
"""Bytes of the first and last frame of an episode."""
FILM = 1_500_000
"""Bytes of a film of sixty actions."""
DECISION = 16
"""Bytes that probes keep per site and episode: decisions, labels and directions, by category and pooled."""
REPORT = 5_000_000
"""Bytes of a report with its figures."""


def space_needed(plan: Plan, settings: RunSettings) -> dict[str, int]:
    """Bytes by part, uncompressed. Probes are those of one view; more views take as much again each."""
    episodes, calls = len(plan.episodes), int(getattr(settings, "captured_calls", 1))
    films = {"all": episodes, "first": 1}.get(str(getattr(settings, "video", "none")), 0)
    thumbnails = 0 if settings.frames == "none" else episodes * THUMBNAILS
    return {
        "activations": plan.bytes,
        "columns": sum(stream.raw_bytes(False) for stream in plan.streams) * calls * episodes,
        "episodes": episodes * EPISODE + thumbnails + films * FILM,
        "probes": plan.sites * episodes * DECISION,
        "report": REPORT if plan.streams else 0,
    }
