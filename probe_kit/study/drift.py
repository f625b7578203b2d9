"""Drift of every category from one run to another: transfer, own probes, directions, likeness, verdict and table.

Stored probes are used on the activations of another run of the same episodes (`train/stored_transfer.py`). Nothing
is fitted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from statistics import NormalDist
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit._tables.content import Number, group_headings
from probe_kit._tables.numbers import number, p_text, percent, points
from probe_kit._tables.table import Cell, Cells, Table
from probe_kit.extract.rollout.answers import side_expected
from probe_kit.hooks.contract.sites import PADDING, Site
from probe_kit.retention.compare.compare import Difference, common_items, wording_of
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.retention.table import retention_table
from probe_kit.runs.layout import FIRST_FRAME
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.cka import unbiased_cka
from probe_kit.statistics.share_limits import effective_episodes, group_shares
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.suite.categories import category_of
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import Direction, ProbeResults
from probe_kit.train.results.store import load_results
from probe_kit.train.stored_transfer import ProbedRun, common_sites, features_of, transfer_stored_probes


def _cosines(first: Direction, second: Direction, features: Matrix) -> tuple[float, float, float]:
    """Return three cosines of the directions of two runs.

    The first is of their unit vectors. The second is weighted by the covariance of the features, which is the
    correlation of the two decisions. The third is the ceiling: the mean between the folds of the first run.

    Args:
        first: Direction of the first run.
        second: Direction of the second run.
        features: (E, D) of the second run.
    """
    before, after = first.unit, second.unit
    varied = features - features.mean(axis=0)
    of_first, of_second = varied @ before, varied @ after
    length = float(np.linalg.norm(of_first) * np.linalg.norm(of_second))
    # Weights of zero, such as of constant features, have no direction and stay zero.
    units = first.weights / np.linalg.norm(first.weights, axis=1, keepdims=True).clip(min=1e-30)
    between = units @ units.T
    folds = len(units)
    ceiling = (between.sum() - np.trace(between)) / (folds * (folds - 1))
    return float(before @ after), float(of_first @ of_second) / length if length else float("nan"), float(ceiling)


# -- categories --------------------------------------------------------------------------------------------------


Verdict = Literal["kept", "transfer not shown", "forgotten", "learned", "not shown in either", "not clear"]
VERDICTS: Mapping[Verdict, str] = {
    "kept": "signal in both, and probes transfer after recentring",
    "transfer not shown": "signal in both, and the test does not find that probes transfer. This is no proof that "
    "the direction moved. In brackets the power: how often the test finds probes that decode the other run as "
    "well as its own do",
    "forgotten": "signal in the first alone, and the 95 % interval of the drop excludes 0",
    "learned": "signal in the second alone, and the 95 % interval of the gain excludes 0",
    "not shown in either": "signal in neither",
    "not clear": "signal in one, and the interval of the difference includes 0 or there is none",
}
"""The meaning of each verdict; signal: above chance family-wise and better than every control that was run."""


@dataclass(frozen=True)
class SiteDrift:
    """One site of one category: accuracies of transferred probes, there and back, and likeness.

    The cosines are None where a side has no signal.

    Attributes:
        cosine: Cosine of the unit vectors of the probes' directions, see `_cosines`.
        weighted: The same cosine weighted by the covariance of the features.
        ceiling: Mean cosine between the folds of the first run.
        lens: Accuracy of the logit lens at this layer, before and after; None unless both runs answer by letter.
    """

    site: Site
    raw: float
    recentred: float
    p_fwe: float
    raw_back: float
    recentred_back: float
    p_fwe_back: float
    cka: float
    cosine: float | None = None
    weighted: float | None = None
    ceiling: float | None = None
    lens: tuple[float, float] | None = None


@dataclass(frozen=True)
class CategoryDrift:
    """One category of two runs; `before` and `after` are their rows of the retention table.

    Attributes:
        difference: After minus before.
        sites: Sites of the backbone, empty where frames or words differ.
        best: The position of the site at which the first run's own probes are best.
        episodes: Number of episodes that both runs have.
        why_alone: Reason why nothing is transferred, empty if it is.
        power: How often the test of the transfer forth finds probes that decode the other run as well as own ones
            do; None where nothing is transferred.
    """

    category: str
    before: RetentionRow
    after: RetentionRow
    difference: Difference | None
    sites: tuple[SiteDrift, ...]
    best: int
    episodes: int
    why_alone: str = ""
    power: float | None = None

    @property
    def verdict(self) -> Verdict:
        """The verdict, a key of VERDICTS.

        It is `not clear` where probes could not be transferred and the verdict depends on that.
        """
        before, after = (row.backbone.verdict == "shown" for row in (self.before, self.after))
        if before and after:
            if not self.sites:
                return "not clear"
            return "kept" if self.p_transfer < SIGNIFICANCE else "transfer not shown"
        if not (before or after):
            return "not shown in either"
        low, high = (self.difference and self.difference.backbone_ci) or (None, None)
        if before:
            return "forgotten" if high is not None and high < 0 else "not clear"
        return "learned" if low is not None and low > 0 else "not clear"

    @property
    def p_transfer(self) -> float:
        """Family-wise p of the recentred transfer over all sites; 1 without any."""
        return min((site.p_fwe for site in self.sites), default=1.0)


def measure_drift(
    before: RunReader,
    after: RunReader,
    view: str = "mean",
    labels: Mapping[str, str] | None = None,
    probes: Sequence[ProbeResults | None] = (None, None),
) -> list[CategoryDrift]:
    """Return the drift of every category that both runs were probed in, in one view.

    Probes are the stored ones of the first captured inference. Frames and words must be the same for a transfer:
    otherwise only own accuracies are given.

    Args:
        before: The first run, such as that of the base checkpoint.
        after: The second run.
        view: A view that both runs were probed in.
        labels: Names of the runs by location; None for their own.
        probes: Probes of both runs, the newest stored ones where None.

    Raises:
        NoProbesError: For a run without probes.
        UnknownSiteError: For a view that was not probed.
        UsageError: Where the backbones have no site of one name and width in common.
    """
    first, second = (
        (run, load_results(run) if results is None else results)
        for run, results in zip((before, after), probes, strict=True)
    )
    locations = str(before.location), str(after.location)
    # A run beside itself, with two sets of probes, has no difference; of a pair it is the first minus the second.
    runs, pairs = ([before, after], [locations[::-1]]) if locations[0] != locations[1] else ([before], [])
    keys = [results.key for _, results in (first, second)[: len(runs)]]
    table = retention_table(runs, [view], labels=labels, pairs=pairs, keys=keys)
    rows = {(row.run.location, row.category): row for row in table.rows if row.view == view}
    gaps = {row.category: row for row in table.differences if row.view == view}
    names = dict.fromkeys(row.category for row in table.rows)
    why = why_alone(before, after, view)
    return [
        _category(
            name, (first, second), view, (rows[locations[0], name], rows[locations[1], name]), gaps.get(name), why
        )
        for name in names
        if all((location, name) in rows for location in locations)
    ]


def why_alone(before: RunReader, after: RunReader, view: str = "mean") -> str:
    """Return the reason why probes of one run are not used on the other: other words or frames; empty if they are.

    A VLM and a policy are compared under three conditions. The VLM was shown the instruction and the frame in the
    size that the policy gets. Both were delivered the same tokens. The view has the same positions in both.
    """
    if wording_of(before) != wording_of(after):
        return "other words"
    if before.ask != after.ask and (why := _why_alone_beside_vlm(before, after, view)):
        return why
    tables = [run.episodes for run in (before, after)]
    if not all(FIRST_FRAME in table for table in tables):
        return "frames unknown"
    both = tables[0][["episode_id", FIRST_FRAME]].merge(tables[1][["episode_id", FIRST_FRAME]], on="episode_id")
    return "" if len(both) and (both[f"{FIRST_FRAME}_x"] == both[f"{FIRST_FRAME}_y"]).all() else "other frames"


def _why_alone_beside_vlm(before: RunReader, after: RunReader, view: str) -> str:
    vlm, policy = (before, after) if before.ask is not None else (after, before)
    ask = vlm.ask or {}
    if policy.ask is not None or "{instruction}" not in ask.get("template", ""):
        return "other words"
    if ask["picture"] != "frame" or _picture_size(vlm) != _picture_size(policy):
        return "other pictures"
    of_vlm, of_policy = _delivered_tokens(vlm, view), _delivered_tokens(policy, view)
    both = of_vlm.keys() & of_policy.keys()
    return "other tokens" if any(None in of_vlm[name] or of_vlm[name] != of_policy[name] for name in both) else ""


def _picture_size(run: Any) -> list[int]:
    scene = run.settings["scene"]
    return list(scene.get("picture_size") or (scene["camera"]["width"], scene["camera"]["height"]))


def _delivered_tokens(run: Any, view: str) -> dict[str, tuple[Any, list[int]]]:
    """Return by episode the instruction's tokens as the model was delivered them, and the positions of a view."""
    role, delivered = view.partition(":")[2], {}
    for commit in run.commits():
        spans = [span for span in commit.roles[0]["backbone"] if span[0] != PADDING]
        # Counted from the first token that is no padding, of which both may have another number in front.
        first = min(start for _, start, _ in spans)
        pooled = [range(start - first, end - first) for name, start, end in spans if role in ("", name)]
        delivered[commit.episode_id] = commit.instruction_ids, [at for span in pooled for at in span]
    return delivered


def _category(
    name: str,
    sides: tuple[ProbedRun, ProbedRun],
    view: str,
    rows: tuple[RetentionRow, RetentionRow],
    difference: Difference | None,
    why: str,
) -> CategoryDrift:
    curves = [results.curves[name, view] for _, results in sides]
    items = common_items([run for run, _ in sides]).get(name)
    episodes = np.intersect1d(curves[0].episodes, curves[1].episodes)
    if items is None or not items.n_items or not episodes.size:
        return CategoryDrift(name, *rows, difference, (), 0, 0, why or "no item in common")
    if why:
        return CategoryDrift(name, *rows, difference, (), 0, episodes.size, why)
    sites = common_sites(sides, name, view)
    forth, back = (
        transfer_stored_probes(probed, other, name, view, sites, episodes)
        for probed, other in (sides, (sides[1], sides[0]))
    )
    lenses = [lens_accuracy(run, episodes) for run, _ in sides]
    drifts = []
    for at, site in enumerate(sites):
        before, after = (features_of(run, site, view, episodes) for run, _ in sides)
        cosines: tuple[float | None, float | None, float | None] = (None, None, None)
        if all(_has_signal(results, name, view, site) for _, results in sides):
            first, second = (results.direction(name, view, site) for _, results in sides)
            cosines = _cosines(first, second, after)
        raw, recentred, p_fwe = forth.at(at)
        raw_back, recentred_back, p_fwe_back = back.at(at)
        likeness = (unbiased_cka(before, after), *cosines, _at_layer(lenses, site.layer))
        drifts.append(SiteDrift(site, raw, recentred, p_fwe, raw_back, recentred_back, p_fwe_back, *likeness))
    accuracies = [curves[0].correct[curves[0].sites.index(site)].mean() for site in sites]
    best = int(np.argmax(accuracies))
    power = min(_power(curve, sites[best], forth.threshold) for curve in curves)
    return CategoryDrift(name, *rows, difference, tuple(drifts), best, episodes.size, power=power)


def _power(curve: ProbeCurve, site: Site, threshold: float) -> float:
    """Return how often decisions as accurate as the probes of a site are more accurate than `threshold`."""
    sums = curve.sums.only([curve.sites.index(site)])
    shares, variances = group_shares(sums.sums, sums.sizes)
    counting, agree = effective_episodes(shares, variances, sums.n_episodes)
    share = float(shares[0])
    count = sums.n_episodes if agree[0] else float(counting[0])
    error = sqrt(max(0.0, share * (1 - share)) / count)
    return NormalDist(share, error).cdf(2 * share - threshold) if error else float(share > threshold)


def lens_accuracy(run: RunReader, episodes: NDArray[np.str_]) -> NDArray[np.float64] | None:
    """Return the share (L,) of these episodes in which layer l would answer with the right side; a tie is half.

    None for a run without margins. Only runs of questions that are answered by letter have margins.
    """
    stored: NDArray[np.float64] | None = run.lens_margins
    if stored is None:
        return None
    rows = run.episodes["episode_id"].isin(episodes).to_numpy()
    margins = stored[rows]
    if np.isnan(margins).any():
        return None
    query = (run.ask or {}).get("object", "target")
    is_left = np.array([side_expected(query, side) == "left" for side in run.episodes["side_correct"][rows]])
    signed = np.where(is_left[:, None], margins, -margins)
    return np.asarray(((signed > 0) + 0.5 * (signed == 0)).mean(axis=0))


def _at_layer(lenses: list[NDArray[np.float64] | None], layer: int) -> tuple[float, float] | None:
    before, after = (None if lens is None or layer >= lens.size else float(lens[layer]) for lens in lenses)
    return None if before is None or after is None else (before, after)


def _has_signal(results: ProbeResults, category: str, view: str, site: Site) -> bool:
    scores = results.scores
    of_site = scores[(scores["category"] == category) & (scores["view"] == view) & (scores["site"] == str(site))]
    return bool(of_site["signal"].iloc[0])


# -- the table ---------------------------------------------------------------------------------------------------


_COLUMNS = (
    ("", ("runs", "category")),
    ("change and own probes", ("change", "before %", "after %", "after − before, points")),
    ("transfer of probes", ("layer", "forth %", "recentred %", "p", "back %", "recentred %")),
    ("likeness", ("cosine (ceiling)", "CKA")),
)
_NOTE = (
    "before, after: cross-fitted accuracy of own probes, with its 95 % interval",
    "layer: where the first run's own probes are best",
    "forth: accuracy of the first run's probes on the second run's activations, nothing is fitted",
    "back: the reverse",
    "recentred: after centring and scaling on the other run's training folds, without labels",
    "p: of the recentred transfer forth, label permutations of whole groups, the best of all layers",
    "cosine: of the probes' directions, where both sides have signal; ceiling: between folds of the first run",
    "CKA: unbiased, likeness of all features; it is no measure of loss",
)
_LENS = ("logit lens", ("lens before %", "lens after %"))
_LENS_NOTE = (
    "lens: share of episodes in which the model's own final norm and head, applied at that layer, name the right "
    "letter; it says what a layer would answer, not what later layers read"
)


def drift_table(pairs: Mapping[tuple[str, str], Sequence[CategoryDrift]], title: str, view: str) -> Table:
    """Return the verdicts with their numbers.

    Args:
        pairs: Drift by the labels of both runs, the first one before the second.
        title: Name of the comparison.
        view: View of the probes.
    """
    drifts = [(names, drift) for names, of_pair in pairs.items() for drift in of_pair]
    has_lens = any(site.lens for _, drift in drifts for site in drift.sites)
    cells: tuple[Cells, ...] = tuple(
        (f"{names[0]} → {names[1]}", category_of(drift.category).title, _verdict(drift), *_cells(drift, has_lens))
        for names, drift in drifts
    )
    verdicts = dict.fromkeys(drift.verdict for _, drift in drifts)
    note = [f"view {view}", *_NOTE, *[_LENS_NOTE][:has_lens], *(f"{name}: {VERDICTS[name]}" for name in verdicts)]
    alone = {f"{names[0]} → {names[1]}": drift.why_alone for names, drift in drifts if drift.why_alone}
    note += [f"{name}: own accuracies only, {why}" for name, why in alone.items()]
    heading = f"Drift: {title}" + (f" ({', '.join(dict.fromkeys(alone.values()))})" if alone else "")
    numbers = tuple(number for names, drift in drifts for number in _numbers(names, drift, view))
    groups = (*_COLUMNS, *[_LENS][:has_lens])
    return Table.of(heading, group_headings(*groups), cells, names=2, notes=note, numbers=numbers)


def _verdict(drift: CategoryDrift) -> str:
    """Return the verdict; of a transfer that is not shown, how often it would be."""
    if drift.verdict != "transfer not shown" or drift.power is None:
        return drift.verdict
    return f"{drift.verdict} (power {percent(drift.power)} %)"


def _cells(drift: CategoryDrift, has_lens: bool) -> tuple[Cell, ...]:
    gap = drift.difference
    accuracies = (
        *(Cell(row.backbone.score, percent, row.backbone.ci) for row in (drift.before, drift.after)),
        Cell(None) if gap is None else Cell(gap.backbone, points, gap.backbone_ci),
    )
    if not drift.sites:
        return (*accuracies, *[Cell(None)] * (10 if has_lens else 8))
    site = drift.sites[drift.best]
    lens = [Cell(share, percent) for share in site.lens or (None, None)]
    return (
        *accuracies,
        Cell(site.site.layer),
        Cell(site.raw, percent),
        Cell(site.recentred, percent),
        Cell(drift.p_transfer, p_text),
        Cell(site.raw_back, percent),
        Cell(site.recentred_back, percent),
        Cell(site.cosine, number, after="" if site.cosine is None else f" ({number(site.ceiling)})"),
        Cell(site.cka, number),
        *(lens if has_lens else ()),
    )


def _numbers(names: tuple[str, str], drift: CategoryDrift, view: str) -> list[Number]:
    """Return the numbers of the category, then those of each site."""
    gap = drift.difference
    names_of_row = {"before": names[0], "after": names[1], "category": drift.category, "view": view}
    of_category: Number = {
        **names_of_row,
        "verdict": drift.verdict,
        "why_alone": drift.why_alone or None,
        "episodes": drift.episodes,
        "accuracy_before": drift.before.backbone.score,
        "accuracy_before_ci": drift.before.backbone.ci,
        "accuracy_after": drift.after.backbone.score,
        "accuracy_after_ci": drift.after.backbone.ci,
        "difference": None if gap is None else gap.backbone,
        "difference_ci": None if gap is None else gap.backbone_ci,
        "p": drift.p_transfer if drift.sites else None,
        "power": drift.power,
    }
    of_sites: list[Number] = [
        {
            **names_of_row,
            "site": str(site.site),
            "layer": site.site.layer,
            "transfer": site.raw,
            "recentred": site.recentred,
            "p_fwe": site.p_fwe,
            "transfer_back": site.raw_back,
            "recentred_back": site.recentred_back,
            "p_fwe_back": site.p_fwe_back,
            "cka": site.cka,
            "cosine": site.cosine,
            "cosine_weighted": site.weighted,
            "cosine_ceiling": site.ceiling,
            "lens_before": None if site.lens is None else site.lens[0],
            "lens_after": None if site.lens is None else site.lens[1],
        }
        for site in drift.sites
    ]
    return [of_category, *of_sites]
