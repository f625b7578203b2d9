"""The table and the sentences of a diagnosis."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit._tables.numbers import p_text, whole, with_limits
from probe_kit._tables.table import Cell, Heading, Table

if TYPE_CHECKING:
    from probe_kit.diagnose.diagnosis import Diagnosis, InputDiagnosis

_HEADINGS = (
    Heading("input"),
    Heading("arrives", "whether any number of any action changed under another value"),
    Heading("effect", "decides, moves, no effect, open, does not arrive, not varied, not an input"),
    Heading("decides %", "share of the action's variance that is due to it: total-effect index, 95 % by groups"),
    Heading("control %", "the same of a change that should not matter"),
    Heading("all inputs %", "the same of all inputs together; the seed decides the rest"),
    Heading("p", "that it changes more than its control, by sign flips of whole groups"),
)
_FINDINGS = {
    "decides": "decides the action",
    "moves": "moves the action, is not shown to decide it",
    "no effect": "arrives and has no effect above that of a change without meaning",
    "open": "arrives; whether it matters is open",
    "does not arrive": "does not arrive: no action changed",
    "not varied": "was not tested",
    "not an input": "is no input of this model",
}


def diagnosis_table(diagnosis: "Diagnosis") -> Table:
    """One line per input, with one sentence per input below it."""
    rows = [_row(diagnosed) for diagnosed in diagnosis.inputs]
    title = f"Inputs of {diagnosis.label}: {diagnosis.n_frames} frames of {diagnosis.n_groups} groups"
    numbers = tuple(diagnosis.to_json()["inputs"])
    return Table.of(
        title, _HEADINGS, rows, notes=[sentence(diagnosed) for diagnosed in diagnosis.inputs], numbers=numbers
    )


def _row(diagnosed: "InputDiagnosis") -> Sequence[Cell]:
    importance = diagnosed.importance
    tested = importance.matters is not None
    texts = (
        diagnosed.name,
        ("yes" if importance.arrives else "no") if tested else "–",
        importance.verdict,
        with_limits(importance.share, importance.share_ci, whole),
        whole(importance.control),
        whole(importance.every),
        p_text(importance.p),
    )
    lost = ("arrives", "verdict") if importance.matters is False else ()
    headed = zip(_HEADINGS, texts, strict=True)
    return [Cell(text, alarm=heading.text in lost) for heading, text in headed]


def sentence(diagnosed: "InputDiagnosis") -> str:
    """Return one sentence: what became of an input, and where."""
    importance = diagnosed.importance
    reason = f" ({importance.reason})" if importance.verdict in ("not varied", "not an input", "open") else ""
    where = f"; {diagnosed.where}" if diagnosed.where else ""
    return f"{diagnosed.name} {_FINDINGS[importance.verdict]}{reason}{where}."
