"""Drift of every category from one run to another: transfer, own probes, directions, likeness, verdict and table.

Stored probes are used on the activations of another run of the same episodes. Nothing is fitted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit._tables.content import Number, grouped
from probe_kit._tables.numbers import number, p_text, percent, points, with_limits
from probe_kit._tables.table import Table
from probe_kit.errors import UsageError
from probe_kit.extract.rollout.answers import side_expected
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import PADDING, Site
from probe_kit.retention.behaviour import ask_of
from probe_kit.retention.compare.compare import Difference, common_items, wording_of
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.retention.table import retention_table
from probe_kit.runs.layout import FIRST_FRAME
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.cka import unbiased_cka
from probe_kit.statistics.label_permutations import flip_groups, max_statistic_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.suite.categories import category_of
from probe_kit.train.crossval.task_scores import correctness
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import Direction, ProbeResults
from probe_kit.train.results.store import load_results

Features = NDArray[np.float64]

PERMUTATIONS = 999
"""Of the labels of whole groups, for the p of a transfer."""
_CONSTANT = 1e-9
"""Share of the largest deviation below which a feature does not vary."""


@dataclass(frozen=True)
class ProbedRun:
    """A run of one wording, with its probes."""

    run: RunReader
    results: ProbeResults

    def features(self, site: Site, view: str, episodes: NDArray[np.str_]) -> Features:
        """(E, D) of these episodes, in this order."""
        at = {name: row for row, name in enumerate(self.run.episodes["episode_id"].astype(str))}
        return np.asarray(self.run.column(site, view)[[at[name] for name in episodes]], np.float64)


@dataclass(frozen=True)
class Transfer:
    """The accuracy of the probes of one run on the activations of another, at S sites, as shares.

    raw: decisions as they are. recentred: features are first centred and scaled as in the other run's own
    training folds, without labels. p_fwe: of `recentred`, against the best site under label permutations of whole
    groups.
    """

    raw: Features
    recentred: Features
    p_fwe: Features


def transfer(
    probed: ProbedRun, other: ProbedRun, category: str, view: str, sites: Sequence[Site], common: NDArray[np.str_]
) -> Transfer:
    """Decisions of `probed`'s probes on `other`'s activations of the `common` episodes.

    Each episode is judged by the probe that was trained without its fold. Raises UnknownSiteError for a site
    without a stored direction.
    """
    curve = probed.results.curves[category, view]
    rows = np.flatnonzero(np.isin(curve.episodes, common))
    episodes, labels = curve.episodes[rows], curve.labels[rows]
    raw, recentred = np.empty((2, len(sites), rows.size))
    for at, site in enumerate(sites):
        direction = probed.results.direction(category, view, site)
        of_probed, of_other = (run.features(site, view, episodes) for run in (probed, other))
        raw[at] = _decisions(direction, of_other, of_other, of_other, curve.fold_of[rows], curve)
        recentred[at] = _decisions(direction, of_other, of_probed, of_other, curve.fold_of[rows], curve)
    null = flip_groups(labels, curve.groups[rows], PERMUTATIONS, derive_seed("transfer", category, view))
    right = np.array([correctness(run[:, None], null).mean(axis=0) for run in recentred])
    accuracies = (correctness(run, labels[None, :]).mean(axis=1) for run in (raw, recentred))
    accuracy, aligned = accuracies
    return Transfer(accuracy, aligned, max_statistic_p(aligned, right))


def _decisions(
    direction: Direction,
    features: Features,
    like: Features,
    origin: Features,
    fold_of: NDArray[np.int64],
    curve: ProbeCurve,
) -> Features:
    """Return (E,) decisions on features (E, D), moved and scaled from `origin`'s training folds to `like`'s."""
    decisions = np.empty(len(features))
    for position, fold in enumerate(np.unique(curve.fold_of)):
        tested = fold_of == fold
        moved = features[tested]
        if like is not origin:
            moved = _moved(moved, origin[~tested], like[~tested])
        decisions[tested] = moved @ direction.weights[position].astype(np.float64) + direction.intercepts[position]
    return decisions


def _moved(features: Features, origin: Features, like: Features) -> Features:
    """Features with means and deviations of `like` instead of those of `origin`; constant ones become means."""
    spread = origin.std(axis=0)
    scale = np.divide(like.std(axis=0), spread, out=np.zeros_like(spread), where=spread > _CONSTANT * spread.max())
    moved: Features = (features - origin.mean(axis=0)) * scale + like.mean(axis=0)
    return moved


@dataclass(frozen=True)
class Agreement:
    """Cosines of the directions of two runs at a site.

    raw: of their unit vectors. weighted: by the covariance of the second run's activations, which is the
    correlation of the two decisions. ceiling: mean raw cosine between the folds of the first run.
    """

    raw: float
    weighted: float
    ceiling: float


def agreement(first: Direction, second: Direction, features: Features) -> Agreement:
    """Return the cosines of the directions of two runs. features: (E, D) of the second run."""
    before, after = first.unit, second.unit
    varied = features - features.mean(axis=0)
    # Weights of zero, such as of constant features, have no direction and stay zero.
    units = first.weights / np.linalg.norm(first.weights, axis=1, keepdims=True).clip(min=1e-30)
    between = units @ units.T
    folds = len(units)
    ceiling = (between.sum() - np.trace(between)) / (folds * (folds - 1))
    return Agreement(float(before @ after), _cosine(varied @ before, varied @ after), float(ceiling))


def _cosine(first: Features, second: Features) -> float:
    length = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float(first @ second) / length if length else float("nan")


Verdict = Literal["kept", "transfer not shown", "forgotten", "learned", "not shown in either", "not clear"]
VERDICTS: Mapping[Verdict, str] = {
    "kept": "signal in both, and probes transfer after recentring",
    "transfer not shown": "signal in both, and the items are too few to tell whether probes transfer",
    "forgotten": "signal in the first alone, and the 95 % interval of the drop excludes 0",
    "learned": "signal in the second alone, and the 95 % interval of the gain excludes 0",
    "not shown in either": "signal in neither",
    "not clear": "signal in one, and the interval of the difference includes 0 or there is none",
}
"""What each means; signal: above chance family-wise and better than every control that was run."""


@dataclass(frozen=True)
class SiteDrift:
    """One site of one category: accuracies of transferred probes, there and back, and likeness.

    lens: accuracy of the logit lens at this layer, before and after; None unless both runs answer by letter.
    """

    site: Site
    raw: float
    recentred: float
    p_fwe: float
    raw_back: float
    recentred_back: float
    p_fwe_back: float
    cka: float
    agreement: Agreement | None
    lens: tuple[float, float] | None = None


@dataclass(frozen=True)
class CategoryDrift:
    """One category of two runs; `before` and `after` are their rows of the retention table.

    difference: after minus before. sites: of the backbone, empty where frames or words differ; best: the position
    of the one at which the first run's own probes are best. why_alone: why nothing is transferred, empty if it is.
    """

    category: str
    before: RetentionRow
    after: RetentionRow
    difference: Difference | None
    sites: tuple[SiteDrift, ...]
    best: int
    episodes: int
    why_alone: str = ""

    @property
    def verdict(self) -> Verdict:
        """One of VERDICTS; `not clear` where probes could not be transferred and the verdict hangs on that."""
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
    """Drift of every category that both runs were probed in, in one view.

    Probes are the stored ones of the first captured inference. Frames and words must be the same for a transfer:
    otherwise only own accuracies are given. labels: names of the runs by location. probes: of both runs, the
    newest stored ones where None.
    Raises NoProbesError, UnknownSiteError for a view that was not probed, and UsageError where the backbones have
    no site of one name and width in common.
    """
    sides = [
        ProbedRun(run, load_results(run) if results is None else results)
        for run, results in zip((before, after), probes, strict=True)
    ]
    locations = str(before.location), str(after.location)
    # A run beside itself, with two sets of probes, has no difference; of a pair it is the first minus the second.
    runs, pairs = ([before, after], [locations[::-1]]) if locations[0] != locations[1] else ([before], [])
    keys = [side.results.key for side in sides[: len(runs)]]
    table = retention_table(runs, [view], labels=labels, pairs=pairs, keys=keys)
    rows = {(row.run.location, row.category): row for row in table.rows if row.view == view}
    gaps = {row.category: row for row in table.differences if row.view == view}
    names = dict.fromkeys(row.category for row in table.rows)
    why = why_alone(before, after, view)
    return [
        _category(
            name,
            (sides[0], sides[1]),
            view,
            (rows[locations[0], name], rows[locations[1], name]),
            gaps.get(name),
            why,
        )
        for name in names
        if all((location, name) in rows for location in locations)
    ]


def why_alone(before: RunReader, after: RunReader, view: str = "mean") -> str:
    """Why probes of one run are not used on the other: other words or other frames; empty if they are.

    A VLM and a policy are compared where the VLM was shown the instruction and the frame in the size that the
    policy gets, both were delivered the same tokens, and the view has the same positions in both.
    """
    if wording_of(before) != wording_of(after):
        return "other words"
    if ask_of(before) != ask_of(after):
        return _why_alone_beside_vlm(before, after, view)
    return _why_other_frames(before, after)


def _why_alone_beside_vlm(before: RunReader, after: RunReader, view: str) -> str:
    vlm, policy = (before, after) if ask_of(before) is not None else (after, before)
    ask = ask_of(vlm) or {}
    if ask_of(policy) is not None or "{instruction}" not in ask.get("template", ""):
        return "other words"
    if ask["picture"] != "frame" or _picture_size(vlm) != _picture_size(policy):
        return "other pictures"
    of_vlm, of_policy = _delivered(vlm, view), _delivered(policy, view)
    if any(None in of_vlm[name] or of_vlm[name] != of_policy[name] for name in of_vlm.keys() & of_policy.keys()):
        return "other tokens"
    return _why_other_frames(before, after)


def _picture_size(run: Any) -> list[int]:
    """Width and height in pixels of what the model is handed."""
    scene = run.settings["scene"]
    return list(scene.get("picture_size") or (scene["camera"]["width"], scene["camera"]["height"]))


def _delivered(run: Any, view: str) -> dict[str, tuple[Any, list[int]]]:
    """Return by episode the instruction's tokens as the model was delivered them, and the positions of a view."""
    role, delivered = view.partition(":")[2], {}
    for commit in run.commits():
        spans = [span for span in commit.roles[0]["backbone"] if span[0] != PADDING]
        # Counted from the first token that is no padding, of which both may have another number in front.
        first = min(start for _, start, _ in spans)
        pooled = [range(start - first, end - first) for name, start, end in spans if role in ("", name)]
        delivered[commit.episode_id] = commit.instruction_ids, [at for span in pooled for at in span]
    return delivered


def _why_other_frames(before: RunReader, after: RunReader) -> str:
    tables = [run.episodes for run in (before, after)]
    if not all(FIRST_FRAME in table for table in tables):
        return "frames unknown"
    both = tables[0][["episode_id", FIRST_FRAME]].merge(tables[1][["episode_id", FIRST_FRAME]], on="episode_id")
    return "" if len(both) and (both[f"{FIRST_FRAME}_x"] == both[f"{FIRST_FRAME}_y"]).all() else "other frames"


def _category(
    name: str,
    sides: tuple[ProbedRun, ProbedRun],
    view: str,
    rows: tuple[RetentionRow, RetentionRow],
    difference: Difference | None,
    why: str,
) -> CategoryDrift:
    curves = [side.results.curves[name, view] for side in sides]
    items = common_items([side.run for side in sides]).get(name)
    episodes = np.intersect1d(curves[0].episodes, curves[1].episodes)
    if items is None or not items.n_items or not episodes.size:
        return CategoryDrift(name, *rows, difference, (), 0, 0, why or "no item in common")
    if why:
        return CategoryDrift(name, *rows, difference, (), 0, episodes.size, why)
    sites = _common_sites(sides, name, view)
    forth, back = (
        transfer(probed, second, name, view, sites, episodes) for probed, second in (sides, (sides[1], sides[0]))
    )
    lenses = [lens_accuracy(side.run, episodes) for side in sides]
    site_drifts = tuple(
        replace(_site(at, site, sides, name, view, episodes, (forth, back)), lens=_at_layer(lenses, site.layer))
        for at, site in enumerate(sites)
    )
    accuracies = [curves[0].correct[curves[0].sites.index(site)].mean() for site in sites]
    return CategoryDrift(name, *rows, difference, site_drifts, int(np.argmax(accuracies)), episodes.size)


def lens_accuracy(run: RunReader, episodes: NDArray[np.str_]) -> NDArray[np.float64] | None:
    """Return (L,) the share of these episodes in which layer l would answer with the right side; a tie is half.

    None for a run without margins, which is every run but questions that are answered by letter.
    """
    stored: NDArray[np.float64] | None = run.lens_margins
    if stored is None:
        return None
    rows = run.episodes["episode_id"].isin(episodes).to_numpy()
    margins = stored[rows]
    if np.isnan(margins).any():
        return None
    query = (ask_of(run) or {}).get("object", "target")
    is_left = np.array([side_expected(query, side) == "left" for side in run.episodes["side_correct"][rows]])
    signed = np.where(is_left[:, None], margins, -margins)
    return np.asarray(((signed > 0) + 0.5 * (signed == 0)).mean(axis=0))


def _at_layer(lenses: list[NDArray[np.float64] | None], layer: int) -> tuple[float, float] | None:
    before, after = (None if lens is None or layer >= lens.size else float(lens[layer]) for lens in lenses)
    return None if before is None or after is None else (before, after)


def _common_sites(sides: tuple[ProbedRun, ProbedRun], category: str, view: str) -> list[Site]:
    """Sites of both backbones, by name, where these are equally wide."""
    widths = []
    for side in sides:
        curve = side.results.curves[category, view]
        width = {name: stream.width for name, stream in side.run.streams.items()}
        widths.append({site: width[site.stream] for site in curve.sites if site.stream == curve.backbone_stream})
    shared = [site for site in widths[0] if widths[0][site] == widths[1].get(site)]
    if not shared:
        raise UsageError(
            f"{sides[0].run.location} and {sides[1].run.location} have no site of the backbone with one name and "
            "width in common: probes of one cannot be used on the other"
        )
    return shared


def _site(
    at: int,
    site: Site,
    sides: tuple[ProbedRun, ProbedRun],
    category: str,
    view: str,
    episodes: NDArray[np.str_],
    transfers: tuple[Transfer, Transfer],
) -> SiteDrift:
    before, after = (side.features(site, view, episodes) for side in sides)
    signal = all(_has_signal(side, category, view, site) for side in sides)
    directions = [side.results.direction(category, view, site) for side in sides]
    to, back = transfers
    directions_agree = agreement(directions[0], directions[1], after) if signal else None
    return SiteDrift(
        site=site,
        raw=float(to.raw[at]),
        recentred=float(to.recentred[at]),
        p_fwe=float(to.p_fwe[at]),
        raw_back=float(back.raw[at]),
        recentred_back=float(back.recentred[at]),
        p_fwe_back=float(back.p_fwe[at]),
        cka=unbiased_cka(before, after),
        agreement=directions_agree,
    )


def _has_signal(side: ProbedRun, category: str, view: str, site: Site) -> bool:
    scores = side.results.scores
    of_site = scores[(scores["category"] == category) & (scores["view"] == view) & (scores["site"] == str(site))]
    return bool(of_site["signal"].iloc[0])


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
    """Verdicts with their numbers. pairs: by the labels of both runs, the first one before the second."""
    drifts = [(names, drift) for names, of_pair in pairs.items() for drift in of_pair]
    has_lens = any(site.lens for _, drift in drifts for site in drift.sites)
    cells = tuple(
        (
            f"{before} → {after}",
            category_of(drift.category).title,
            drift.verdict,
            *_cells(drift),
            *_lens(drift)[: 2 * has_lens],
        )
        for (before, after), drift in drifts
    )
    verdicts = dict.fromkeys(drift.verdict for _, drift in drifts)
    note = [f"view {view}", *_NOTE, *[_LENS_NOTE][:has_lens], *(f"{name}: {VERDICTS[name]}" for name in verdicts)]
    alone = {f"{names[0]} → {names[1]}": drift.why_alone for names, drift in drifts if drift.why_alone}
    note += [f"{name}: own accuracies only, {why}" for name, why in alone.items()]
    heading = f"Drift: {title}" + (f" ({', '.join(dict.fromkeys(alone.values()))})" if alone else "")
    numbers = tuple(number for names, drift in drifts for number in _numbers(names, drift, view))
    groups = (*_COLUMNS, *[_LENS][:has_lens])
    return Table.of(heading, grouped(*groups), cells, names=2, notes=note, numbers=numbers)


def _cells(drift: CategoryDrift) -> tuple[str, ...]:
    gap = drift.difference
    accuracies = (
        _row_key(drift.before),
        _row_key(drift.after),
        "–" if gap is None else with_limits(gap.backbone, gap.backbone_ci, points),
    )
    if not drift.sites:
        return (*accuracies, *["–"] * 8)
    site = drift.sites[drift.best]
    return (
        *accuracies,
        str(site.site.layer),
        percent(site.raw),
        percent(site.recentred),
        p_text(drift.p_transfer),
        percent(site.raw_back),
        percent(site.recentred_back),
        _cosine_text(site),
        number(site.cka),
    )


def _lens(drift: CategoryDrift) -> tuple[str, str]:
    lens = drift.sites[drift.best].lens if drift.sites else None
    return ("–", "–") if lens is None else (percent(lens[0]), percent(lens[1]))


def _row_key(row: RetentionRow) -> str:
    return with_limits(row.backbone.score, row.backbone.ci, percent)


def _cosine_text(site: SiteDrift) -> str:
    return "–" if site.agreement is None else f"{number(site.agreement.raw)} ({number(site.agreement.ceiling)})"


def _numbers(names: tuple[str, str], drift: CategoryDrift, view: str) -> list[Number]:
    """One of the category, then one of each site."""
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
    }
    return [of_category, *({**names_of_row, **_of_site(site)} for site in drift.sites)]


def _of_site(site: SiteDrift) -> Number:
    directions = site.agreement
    return {
        "site": str(site.site),
        "layer": site.site.layer,
        "transfer": site.raw,
        "recentred": site.recentred,
        "p_fwe": site.p_fwe,
        "transfer_back": site.raw_back,
        "recentred_back": site.recentred_back,
        "p_fwe_back": site.p_fwe_back,
        "cka": site.cka,
        "cosine": None if directions is None else directions.raw,
        "cosine_weighted": None if directions is None else directions.weighted,
        "cosine_ceiling": None if directions is None else directions.ceiling,
        "lens_before": None if site.lens is None else site.lens[0],
        "lens_after": None if site.lens is None else site.lens[1],
    }
