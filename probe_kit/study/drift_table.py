"""The table of drift: a row per pair of runs and category, the transfer of probes first."""

from collections.abc import Mapping, Sequence

from probe_kit._tables.content import Number, grouped
from probe_kit._tables.numbers import number, p_text, percent, points, with_limits
from probe_kit._tables.table import Table
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.study.drift import VERDICTS, CategoryDrift, SiteDrift
from probe_kit.suite.categories import category_of

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
        _cosine(site),
        number(site.cka),
    )


def _lens(drift: CategoryDrift) -> tuple[str, str]:
    lens = drift.sites[drift.best].lens if drift.sites else None
    return ("–", "–") if lens is None else (percent(lens[0]), percent(lens[1]))


def _row_key(row: RetentionRow) -> str:
    return with_limits(row.backbone.score, row.backbone.ci, percent)


def _cosine(site: SiteDrift) -> str:
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
