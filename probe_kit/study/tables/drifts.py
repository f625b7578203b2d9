"""The table of drift: a row per pair of runs and category, the transfer of probes first."""

from collections.abc import Mapping, Sequence

from probe_kit._tables.numbers import number, p_text, percent, points, with_limits
from probe_kit._tables.table import grouped
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.study.drift.measures import VERDICTS, CategoryDrift, SiteDrift
from probe_kit.study.tables.named_table import NamedTable, Number
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


def drift_table(pairs: Mapping[tuple[str, str], Sequence[CategoryDrift]], title: str, view: str) -> NamedTable:
    """Verdicts with their numbers. pairs: by the labels of both runs, the first one before the second."""
    shown = [(names, one) for names, found in pairs.items() for one in found]
    has_lens = any(site.lens for _, one in shown for site in one.sites)
    cells = tuple(
        (
            f"{before} → {after}",
            category_of(one.category).title,
            one.verdict,
            *_cells(one),
            *_lens(one)[: 2 * has_lens],
        )
        for (before, after), one in shown
    )
    said = dict.fromkeys(one.verdict for _, one in shown)
    note = [f"view {view}", *_NOTE, *[_LENS_NOTE][:has_lens], *(f"{name}: {VERDICTS[name]}" for name in said)]
    alone = {f"{names[0]} → {names[1]}": one.why_alone for names, one in shown if one.why_alone}
    note += [f"{name}: own accuracies only, {why}" for name, why in alone.items()]
    heading = f"Drift: {title}" + (f" ({', '.join(dict.fromkeys(alone.values()))})" if alone else "")
    numbers = tuple(number for names, one in shown for number in _numbers(names, one, view))
    groups = (*_COLUMNS, *[_LENS][:has_lens])
    return NamedTable.of(heading, grouped(*groups), cells, names=2, notes=note, numbers=numbers)


def _cells(one: CategoryDrift) -> tuple[str, ...]:
    gap = one.difference
    own = (
        _own(one.before),
        _own(one.after),
        "–" if gap is None else with_limits(gap.backbone, gap.backbone_ci, points),
    )
    if not one.sites:
        return (*own, *["–"] * 8)
    site = one.sites[one.best]
    return (
        *own,
        str(site.site.layer),
        percent(site.raw),
        percent(site.recentred),
        p_text(one.p_transfer),
        percent(site.raw_back),
        percent(site.recentred_back),
        _cosine(site),
        number(site.cka),
    )


def _lens(one: CategoryDrift) -> tuple[str, str]:
    found = one.sites[one.best].lens if one.sites else None
    return ("–", "–") if found is None else (percent(found[0]), percent(found[1]))


def _own(row: RetentionRow) -> str:
    return with_limits(row.backbone.score, row.backbone.ci, percent)


def _cosine(site: SiteDrift) -> str:
    return "–" if site.agreement is None else f"{number(site.agreement.raw)} ({number(site.agreement.ceiling)})"


def _numbers(names: tuple[str, str], one: CategoryDrift, view: str) -> list[Number]:
    """One of the category, then one of each site."""
    gap = one.difference
    place = {"before": names[0], "after": names[1], "category": one.category, "view": view}
    whole: Number = {
        **place,
        "verdict": one.verdict,
        "why_alone": one.why_alone or None,
        "episodes": one.episodes,
        "accuracy_before": one.before.backbone.score,
        "accuracy_before_ci": one.before.backbone.ci,
        "accuracy_after": one.after.backbone.score,
        "accuracy_after_ci": one.after.backbone.ci,
        "difference": None if gap is None else gap.backbone,
        "difference_ci": None if gap is None else gap.backbone_ci,
        "p": one.p_transfer if one.sites else None,
    }
    return [whole, *({**place, **_of_site(site)} for site in one.sites)]


def _of_site(site: SiteDrift) -> Number:
    found = site.agreement
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
        "cosine": None if found is None else found.raw,
        "cosine_weighted": None if found is None else found.weighted,
        "cosine_ceiling": None if found is None else found.ceiling,
        "lens_before": None if site.lens is None else site.lens[0],
        "lens_after": None if site.lens is None else site.lens[1],
    }
