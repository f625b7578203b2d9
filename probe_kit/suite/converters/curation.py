"""The curation file: a person's decisions (accept, reject, reword) as JSON lines or CSV, with previews."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image

from probe_kit._system.bounded_files import parse_json, read_regular
from probe_kit._system.drafts import write_whole
from probe_kit._system.escaping import csv_of_rows
from probe_kit._system.table_cells import is_missing, plain_cell, truth_of
from probe_kit._system.text_tables import open_table
from probe_kit.errors import SuiteError
from probe_kit.suite.converters.candidates import SourcePicture, Wording
from probe_kit.suite.converters.pairing import Proposal
from probe_kit.suite.items import instruction_for

STATUSES = ("pending", "accept", "reject", "edited")
COLUMNS = (
    *("candidate_id", "category", "source_id", "left_preview", "right_preview", "question", "question_sha256"),
    *("proposed_instruction", "rule_id", "status", "instruction", "object_phrase", "polarity", "recognisable"),
    *("reason", "reviewer", "date", "llm"),
)
_DECIDED = ("question_sha256", "status", "instruction", "object_phrase", "polarity", "recognisable")
"""Columns that decide whether and how a candidate is used."""
_TABLES = (".csv", ".tsv")
_PREVIEW_PIXELS = 160

Row = Mapping[str, Any]
Render = Callable[[SourcePicture], Image.Image]


def write_curation(path: Path, proposals: Sequence[Proposal], render: Render) -> None:
    """Write the curation file to `path`, and previews to a folder next to it.

    In the previews, the correct picture lies left. `.csv` and `.tsv` give CSV, anything else JSON lines.

    Raises:
        SuiteError: If the file exists and a person has reviewed any row of it, or if it cannot be read.
    """
    if path.exists():
        try:
            reviewed = sum(row["status"] != STATUSES[0] for row in read_curation(path))
        except SuiteError as error:
            raise SuiteError(
                f"{path} exists and would be written anew, and is no review that can be read: {error} Name "
                "another file as emit_curation (--emit-curation), or remove this one"
            ) from error
        if reviewed:
            raise SuiteError(
                f"{path} holds the review of {reviewed} pairs, and would be written anew without it. Give it as "
                "curation (--curation), or another file as emit_curation (--emit-curation)"
            )
    previews = path.with_name(f"{path.stem}-previews")
    previews.mkdir(parents=True, exist_ok=True)
    rows = [_row(proposal, _previews(proposal, previews, render)) for proposal in proposals]
    if path.suffix.lower() in _TABLES:
        text = csv_of_rows(COLUMNS, ({**row, "llm": json.dumps(row["llm"])} for row in rows))
    else:
        text = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows)
    write_whole(path, text)


def read_curation(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a curation file, one per candidate.

    Cells are texts without white space around them; `status` and `recognisable` are in lower case.

    Raises:
        SuiteError: For a line that cannot be used; the message names it.
    """
    if not path.is_file():
        raise SuiteError(f"curation file {path} not found. Make one with emit_curation (--emit-curation).")
    records: Iterable[tuple[str, Row]] = _from_lines(path)
    if path.suffix.lower() in _TABLES:
        table = open_table(path, COLUMNS, SuiteError)
        records = ((table.where(line), cells) for line, cells in table.rows())
    rows: dict[str, tuple[str, dict[str, Any]]] = {}
    for where, record in records:
        row = _decisions_in_lower_case({name: _text(cell) for name, cell in record.items()}, where)
        before = rows.setdefault(row["candidate_id"], (where, row))
        changed = [name for name in _DECIDED if before[1].get(name, "") != row.get(name, "")]
        if changed:
            raise SuiteError(
                f"{where}: {row['candidate_id']} has {changed[0]} {row.get(changed[0], '')!r}, and in {before[0]} "
                f"{before[1].get(changed[0], '')!r}. Leave one of the two out"
            )
    return [row for _, row in rows.values()]


def _text(cell: Any) -> Any:
    """Return a cell as the reader of tables gives it: an empty text for a missing one."""
    if not isinstance(cell, str):
        return "" if cell is None else cell
    text = plain_cell(cell)
    return "" if is_missing(text) else text


def _decisions_in_lower_case(row: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the row with its decisions in lower case.

    Raises:
        SuiteError: For a row without an id, hash or status, or with an unknown decision.
    """
    missing = [name for name in ("candidate_id", "question_sha256", "status") if not row.get(name)]
    if missing:
        raise SuiteError(f"{where} has no {missing[0]}; expected the columns {', '.join(COLUMNS)}.")
    where, status = f"{where} ({row['candidate_id']})", str(row["status"]).lower()
    if status not in STATUSES:
        raise SuiteError(f"{where}: status is {row['status']!r}; expected one of {', '.join(STATUSES)}.")
    answer = row.get("recognisable", "")
    truth = None if answer == "" else truth_of(answer)
    if truth is None and answer != "":
        raise SuiteError(f"{where}: recognisable is {answer!r}; expected yes, no or an empty cell.")
    return {**row, "status": status, "recognisable": "" if truth is None else "yes" if truth else "no"}


def apply_curation(proposals: Sequence[Proposal], rows: Sequence[Row], path: Path) -> dict[str, Proposal]:
    """Return the accepted proposals by candidate id, reworded where a person did so.

    Raises:
        SuiteError: For ids that this conversion does not have, or for rows whose question has changed since.
    """
    by_id = {proposal.candidate_id: proposal for proposal in proposals}
    unknown = [row["candidate_id"] for row in rows if row["candidate_id"] not in by_id]
    if unknown:
        raise SuiteError(
            f"{path}: {len(unknown)} unknown ids, such as {', '.join(unknown[:5])}. "
            "Use the root, categories, seed and options that the file was made with."
        )
    stale = [
        row["candidate_id"]
        for row in rows
        if row["question_sha256"] != by_id[row["candidate_id"]].candidate.question_sha256
    ]
    if stale:
        raise SuiteError(
            f"{path}: {len(stale)} stale rows, such as {', '.join(stale[:5])}: their questions changed since. "
            "Make a new file with emit_curation and review those again."
        )
    return {
        row["candidate_id"]: _review_proposal(by_id[row["candidate_id"]], row, path)
        for row in rows
        if row["status"] in ("accept", "edited") and row["recognisable"] != "no"
    }


def _review_proposal(proposal: Proposal, row: Row, path: Path) -> Proposal:
    if row["status"] == "accept":
        if proposal.wording is None:
            raise SuiteError(
                f"{path}: {row['candidate_id']} is accepted but has no instruction. Set its status to edited and "
                "fill in instruction and object_phrase."
            )
        return replace(proposal, curation_status="accepted")
    instruction, phrase = str(row.get("instruction") or ""), str(row.get("object_phrase") or "")
    articles = [article for article in ("the", "none") if instruction == instruction_for(phrase, article)]
    if not phrase or not articles:
        raise SuiteError(
            f"{path}: {row['candidate_id']}: instruction {instruction!r} and object_phrase {phrase!r} do not fit; "
            f"expected {instruction_for(phrase or '<object_phrase>', 'the')!r}."
        )
    rule_id = proposal.wording.rule_id if proposal.wording else "R0"
    wording = Wording(phrase, rule_id, article=articles[0])
    return replace(proposal, wording=wording, curation_status="edited")


def _row(proposal: Proposal, previews: tuple[str, str]) -> dict[str, Any]:
    wording, candidate = proposal.wording, proposal.candidate
    return {
        "candidate_id": proposal.candidate_id,
        "category": candidate.category,
        "source_id": proposal.source_id,
        "left_preview": previews[0],
        "right_preview": previews[1],
        "question": candidate.question,
        "question_sha256": candidate.question_sha256,
        "proposed_instruction": proposal.instruction,
        "rule_id": wording.rule_id if wording else "R0",
        "status": "pending",
        "instruction": proposal.instruction,
        "object_phrase": wording.phrase if wording else "",
        "polarity": proposal.polarity,
        **dict.fromkeys(("recognisable", "reason", "reviewer", "date"), ""),
        "llm": dict(wording.proposed_by or {}) if wording else {},
    }


def _previews(proposal: Proposal, folder: Path, render: Render) -> tuple[str, str]:
    names = []
    for role, picture in (("asked", proposal.target), ("other", proposal.distractor)):
        name = f"{proposal.candidate_id}-{role}.png"
        image = render(picture)
        image.thumbnail((_PREVIEW_PIXELS, _PREVIEW_PIXELS))
        image.save(folder / name)
        names.append(f"{folder.name}/{name}")
    return names[0], names[1]


def _from_lines(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    try:
        text = read_regular(path).decode("utf-8-sig")
    except OSError as problem:
        raise SuiteError(f"{path} cannot be read: {problem.strerror}. Give the file of a review.") from problem
    except UnicodeDecodeError as problem:
        raise SuiteError(f"{path} is not UTF-8 text ({problem}). Save it as UTF-8.") from problem
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.strip():
            continue
        where = f"{path}, line {number}"
        try:
            row = parse_json(line)
        except ValueError as problem:
            raise SuiteError(f"{where}: not valid JSON ({problem}). Restore the line.") from problem
        if not isinstance(row, dict):
            raise SuiteError(f"{where}: a JSON {type(row).__name__}; expected an object. Restore the line.")
        yield where, row
