"""The sentences about a row whose target is no side: a short one for the end of a command, and one in full."""

from probe_kit._system.counting import counted, enumerated
from probe_kit._tables.numbers import number, whole_percent, with_limits
from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.rows.probe_parts import NO_STEP
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.statistics.significance import SIGNIFICANCE


def label_finding(row: RetentionRow) -> str:
    """Return whether probes decode the label in the backbone and how much of that is left in the action."""
    if not row.retention.defined:
        is_open = row.backbone.p_fwe is None or row.action.peak is None
        return f"{'open' if is_open else 'not shown'}: {_missing(row)}."
    action = label_of(row.action.stream or "action")
    if row.action.missed:
        missed = enumerated(row.action.missed)
        where = f"in the {action} not beyond {missed}"
        return f"encoded, not shown in the action: probes read it in the backbone; {where}."
    share_left = (
        ""
        if row.retention.value is None
        else f"; {whole_percent(row.retention.value)} % of its score above chance is left"
    )
    return f"encoded and passed on: probes read it in the backbone and the {action}{share_left}."


def _missing(row: RetentionRow) -> str:
    """Return what is missing for retention to be defined."""
    backbone = row.backbone
    if backbone.peak is None or row.action.peak is None:
        return f"no site of the {'backbone' if backbone.peak is None else 'action'} was probed"
    if backbone.p_fwe is None:
        return "no permuted labels say what chance is; train with permutations"
    if row.retention.note == NO_STEP:
        return "the control step was not run, and the step of the episode may say as much"
    if backbone.missed and backbone.remedy:
        return f"no p can fall below the level: {backbone.remedy}"
    if backbone.missed:
        return f"probes of the backbone do no better than {enumerated(backbone.missed)}"
    return "the backbone holds too little of it above chance to divide by"


def label_details(row: RetentionRow) -> str:
    """Return the finding with its numbers, their uncertainty and sizes; to be set behind the name."""
    where = f"(view {row.view})"
    if not row.retention.defined:
        return f"{where}: retention is not defined: {row.retention.reason}."
    share_left = with_limits(row.retention.value, row.retention.ci, number)
    missed = row.action.missed
    reached = f"not shown to exceed {', '.join(missed)}" if missed else f"signal there (p < {SIGNIFICANCE})"
    action = label_of(row.action.stream or "action")
    return (
        f"{where}: {share_left} of the backbone's score above chance is left in the {action}; {reached}. "
        f"{counted(row.controls.n_groups or 0, 'group')}, {counted(row.controls.n_samples or 0, 'sample')}."
    )
