"""The table and the sentences of a diagnosis."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit._tables.numbers import p_text, whole_percent, with_limits
from probe_kit._tables.table import Cell, Heading, Table
from probe_kit.diagnose.importance import INPUTS_DECIDE
from probe_kit.diagnose.results import MATTERS

if TYPE_CHECKING:
    from probe_kit.diagnose.results import Diagnosis, InputDiagnosis

_HEADINGS = (
    Heading("input"),
    Heading("arrives", "whether any number of any action changed under another value"),
    Heading("effect", "decides, moves, no effect, open, does not arrive, not varied, not an input"),
    Heading("decides %", "share of the action's variance that is due to it: total-effect index, 95 % by groups"),
    Heading("control %", "the same of a change that should not matter"),
    Heading("all inputs %", "the same of all inputs together; the seed decides the rest"),
    Heading("p", "that it changes more than its control, by permutation in whole groups"),
)
_FINDINGS = {
    "decides": "decides the action",
    "moves": "moves the action, is not shown to decide it",
    "no effect": "arrives and changes the action by less than 1 % more than a change without meaning",
    "open": "arrives; whether it matters is open",
    "does not arrive": "does not arrive",
    "not varied": "was not tested",
    "not an input": "is no input of this model",
}
_CHANGES = {
    "lost in fine-tuning": "it was lost in fine-tuning",
    "weaker": "it is weaker than in the base",
    "never there": "the base does not use it either",
    "in both": "the base uses it too",
    "stronger": "it is stronger than in the base",
    "gained": "it was gained in fine-tuning",
    "open": "the difference to the base is open",
}
_OF_BASE = (
    Heading("base %", "the share of the base checkpoint, on the same pairs"),
    Heading("difference %", "of both shares, tuned minus base, 95 % by groups"),
    Heading("p of the difference", "two-sided, by sign flips of whole groups"),
    Heading("change"),
)


def diagnosis_table(diagnosis: "Diagnosis") -> Table:
    """One line per input, with one sentence per input below it, and one of the target."""
    headings = (*_HEADINGS, *_OF_BASE) if diagnosis.base else _HEADINGS
    rows = [_row(diagnosed, headings) for diagnosed in diagnosis.inputs]
    title = f"Inputs of {diagnosis.label}: {diagnosis.n_frames} frames of {diagnosis.n_groups} groups"
    title += f"; base {diagnosis.base}" * bool(diagnosis.base)
    numbers = tuple(diagnosis.to_json()["inputs"])
    return Table.of(title, headings, rows, notes=sentences(diagnosis), numbers=numbers)


def _row(diagnosed: "InputDiagnosis", headings: Sequence[Heading]) -> Sequence[Cell]:
    tested = diagnosed.matters is not None
    texts = [
        diagnosed.name,
        ("yes" if diagnosed.arrives else "no") if tested else "–",
        diagnosed.verdict,
        with_limits(diagnosed.share, diagnosed.share_ci, whole_percent),
        whole_percent(diagnosed.control),
        whole_percent(diagnosed.every),
        p_text(diagnosed.p),
    ]
    if (base := diagnosed.base) is not None:
        texts += [
            whole_percent(base.share),
            with_limits(base.difference, base.ci, whole_percent),
            p_text(base.p),
            base.change,
        ]
    texts += ["–"] * (len(headings) - len(texts))
    alarms = {"arrives", "effect"} if diagnosed.matters is False else set()
    if base is not None and base.change == "lost in fine-tuning":
        alarms.add("change")
    return [Cell(text, alarm=heading.text in alarms) for heading, text in zip(headings, texts, strict=True)]


def sentences(diagnosis: "Diagnosis") -> list[str]:
    """Return what became of every input, whether the seed decides more than they do, and of the target."""
    lines = [sentence(diagnosed) for diagnosed in diagnosis.inputs]
    together = max((diagnosed.every for diagnosed in diagnosis.inputs if diagnosed.matters is not None), default=1)
    if together < INPUTS_DECIDE:
        lines.append(f"all inputs together change {whole_percent(together)} % of the action: the seed decides it.")
    if diagnosis.knowledge is not None:
        decided = any(diagnosed.verdict == "decides" for diagnosed in diagnosis.inputs)
        lines.append(diagnosis.knowledge.describe(decided))
    return lines


def sentence(diagnosed: "InputDiagnosis") -> str:
    """Return one sentence: what became of an input, and where."""
    reason = "" if diagnosed.verdict in MATTERS else f" ({diagnosed.reason})"
    where = f"; {diagnosed.where}" if diagnosed.where else ""
    base = f"; {_CHANGES[diagnosed.base.change]}" if diagnosed.base is not None else ""
    return f"{diagnosed.name} {_FINDINGS[diagnosed.verdict]}{reason}{where}{base}."
