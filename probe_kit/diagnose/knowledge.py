"""The knowledge of a target at the sites that are diagnosed: never known, lost on the way, or known to the end.

Probes are those of `probe-kit train`: they are stored in the run, and `probe-kit retention` shows them too.
"""

from math import nan
from typing import TYPE_CHECKING

from probe_kit.diagnose.results import NO_LIMITS, Knowledge, Limits, SiteKnowledge
from probe_kit.errors import NoProbesError
from probe_kit.retention.estimators.retention import measure_retention, stream_peaks
from probe_kit.retention.estimators.stream_scores import BACKBONE
from probe_kit.retention.labels.estimate import measure_label_retention

if TYPE_CHECKING:
    from probe_kit.runs.run import Run
    from probe_kit.train import ProbeResults, Target

ALL = "all"


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
    value, limits, note = _retention(results)
    metric = str(frame["metric"].iloc[0])
    return Knowledge(results.settings.target, results.key, metric, sites, value, limits, note)


def _retention(results: "ProbeResults") -> tuple[float, Limits, str]:
    if not results.settings.is_side:
        try:
            label = measure_label_retention(results)
        except NoProbesError as error:
            return nan, NO_LIMITS, str(error)
        return label.value, _limits(*label.ci), label.note
    view = results.settings.views[0]
    curve = results.curves[ALL, view]
    backbone = stream_peaks(curve).get(BACKBONE)
    exceeds = None
    if backbone is not None:
        exceeds = results.controls.exceeds(ALL, view, str(backbone.site), backbone.p_fwe)
    side = measure_retention(curve, seed_text=results.settings.seed_text, exceeds=exceeds)
    if side is None:
        return nan, NO_LIMITS, "the model has no backbone, or no action part"
    return side.value, _limits(side.interval.low, side.interval.high), side.note


def _limits(low: float | None, high: float | None) -> Limits:
    return (nan if low is None else low, nan if high is None else high)
