"""Drift of every category from one run to another: transfer, own probes, directions, likeness, and a verdict."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.extract.vqa.scores import side_expected
from probe_kit.hooks.contract.sites import PADDING, Site
from probe_kit.retention.behaviour import ask_of
from probe_kit.retention.compare.compare import Difference, common_items, wording_of
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.retention.table import retention_table
from probe_kit.runs.layout import FIRST_FRAME
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.estimates.cka import unbiased_cka
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.study.transfer import Agreement, ProbedRun, Transfer, agreement, transfer
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import load_results

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
