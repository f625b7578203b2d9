"""The knowledge of a target at the sites that are diagnosed: never known, lost on the way, or known to the end.

Probes are those of `probe-kit train`: they are stored in the run, and `probe-kit retention` shows them too.
"""

from math import nan
from typing import TYPE_CHECKING

from probe_kit.diagnose.results import Knowledge, Limits, SiteKnowledge
from probe_kit.retention.rows.probe_parts import target_row

if TYPE_CHECKING:
    from probe_kit.runs.run import Run
    from probe_kit.train import ProbeResults, Target

ALL = "all"
"""The category that pools all episodes."""


def measure_knowledge(run: "Run", target: "Target | str", seed: int = 0) -> Knowledge:
    """Probe a target at every site of a run, all episodes pooled, or load these probes.

    Raises what `train_probes` raises, such as TooFewGroupsError.
    """
    from probe_kit.train import train_probes

    results = train_probes(run, [ALL], target=target, seed=seed)
    # A layer of a stream with iterations is one site of a diagnosis: the farthest above chance stands for it.
    frame = results.scores.assign(excess=lambda scores: scores["score"] - scores["chance"])
    best = frame.sort_values("excess", ascending=False).drop_duplicates(["stream", "layer"]).sort_index()
    sites = tuple(
        SiteKnowledge(f"{stream}.{layer:02d}", part, float(score), float(chance), bool(signal))
        for stream, layer, part, score, chance, signal in zip(
            *(best[name] for name in ("stream", "layer", "part", "score", "chance", "signal")), strict=True
        )
    )
    value, limits, note = _retention(run, results)
    metric = str(frame["metric"].iloc[0])
    return Knowledge(results.settings.target, results.key, metric, sites, value, limits, note)


def _retention(run: "Run", results: "ProbeResults") -> tuple[float, Limits, str]:
    retained = target_row(run, results, ALL, results.settings.views[0]).retention
    low, high = retained.ci or (None, None)
    return _or_nan(retained.value), (_or_nan(low), _or_nan(high)), retained.note


def _or_nan(value: float | None) -> float:
    return nan if value is None else value
