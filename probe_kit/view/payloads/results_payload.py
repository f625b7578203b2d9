"""The payload of the results that are stored with a run: diagnoses, interventions, probes, action errors."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

from probe_kit._tables.table import Row, Table
from probe_kit.diagnose.diagnosis import load_diagnosis
from probe_kit.diagnose.sentences import diagnosis_table
from probe_kit.errors import RunDamagedError
from probe_kit.intervene.outcomes import stored_interventions
from probe_kit.intervene.results.inventory import listed_interventions
from probe_kit.intervene.results.results import effects_of
from probe_kit.runs.action_errors import action_error_table, compare_actions, why_not_compared
from probe_kit.runs.layout import DIAGNOSES, INTERVENTIONS, PROBES
from probe_kit.runs.results import bundle_keys
from probe_kit.train.results.store import load_results, stored_targets
from probe_kit.train.results.summary import best_sites_findings, best_sites_table
from probe_kit.view.viewed_run import ViewedRun


def results_payload(viewed: ViewedRun) -> dict[str, Any]:
    """Return the tables of a run, each with its kind, its key and its finding in sentences.

    refused: why others cannot be read, such as a diagnosis in the format of another version.
    """
    tables, refused = list[dict[str, Any]](), list[str]()
    for part in _parts(viewed) if len(viewed.run.episodes) else ():
        try:
            tables += part()
        except RunDamagedError as error:
            refused.append(str(error))
    return {"tables": tables, "refused": refused}


def _parts(viewed: ViewedRun) -> Iterator[Callable[[], Iterable[dict[str, Any]]]]:
    """Yield functions that read what is stored, each apart, so that one that cannot be read hides no other."""
    for key in bundle_keys(viewed.run.location, DIAGNOSES):
        yield partial(_diagnosis, viewed, key)
    for read in (_interventions, _targets, _action_errors):
        yield partial(read, viewed)


def stored_keys(viewed: ViewedRun) -> list[str]:
    """Return the keys of all that `results_payload` is made of beside the episodes."""
    return [key for home in (DIAGNOSES, INTERVENTIONS, PROBES) for key in bundle_keys(viewed.run.location, home)]


def _diagnosis(viewed: ViewedRun, key: str) -> Iterator[dict[str, Any]]:
    # The sentences of a diagnosis are the notes of its table.
    yield _table("diagnosis of the inputs", key, diagnosis_table(load_diagnosis(viewed.run, key)), ())


def _interventions(viewed: ViewedRun) -> Iterator[dict[str, Any]]:
    """Yield those that verdicts and tables read; others say no more."""
    used = {listed.key for listed in listed_interventions(viewed.run) if listed.state == "used"}
    for stored in stored_interventions(viewed.run):
        if stored.key in used:
            result = effects_of(viewed.run, stored)
            yield _table(f"intervention {result.kind}", stored.key, result.to_rich(), result.findings)


def _targets(viewed: ViewedRun) -> Iterator[dict[str, Any]]:
    for target in stored_targets(viewed.run):
        results = load_results(viewed.run, target=target)
        yield _table(f"probes of {target}", results.key, best_sites_table([results]), best_sites_findings(results))


def _action_errors(viewed: ViewedRun) -> Iterator[dict[str, Any]]:
    if viewed.run.recorded and why_not_compared(viewed.run) is None:
        yield _table("predicted actions", "", action_error_table(compare_actions(viewed.run)), ())


def _table(kind: str, key: str, table: Table, findings: Sequence[str]) -> dict[str, Any]:
    return {
        "kind": kind,
        "key": key,
        "title": table.title,
        "names": table.names,
        "headings": [
            {"text": heading.text, "help": heading.help, "group": heading.group} for heading in table.headings
        ],
        "rows": [_row(row) for row in table.rows],
        "notes": list(table.notes),
        "findings": list(findings),
    }


def _row(row: Row) -> list[dict[str, Any]]:
    return [{"text": cell.text, "strong": cell.strong, "note": cell.note} for cell in row.cells]
