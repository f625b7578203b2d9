"""The page of labels: one HTML file with their retention, figures and controls."""

from collections.abc import Sequence
from pathlib import Path

from probe_kit._system.drafts import write_whole
from probe_kit.retention.behaviour.run_labels import full_names
from probe_kit.retention.labels.table import LabelRetentionTable
from probe_kit.retention.report.label_sections import label_sections
from probe_kit.retention.report.provenance import citation, provenance
from probe_kit.retention.report.render import render
from probe_kit.retention.report.words import words_of
from probe_kit.train.data.run_reader import RunReader
from probe_kit.version import __version__


def write_label_report(runs: Sequence[RunReader], path: Path | str, table: LabelRetentionTable) -> Path:
    """Write the report of a table of labels as one HTML file, whole or not at all, and return its path.

    runs: those that the table was made of, of scenes, recordings or an environment of one's own. No picture of an
    episode is in it. Raises UsageError for a run that the table was not made of.
    """
    path = Path(path)
    write_whole(path, label_report_html(runs, table))
    return path


def label_report_html(runs: Sequence[RunReader], table: LabelRetentionTable) -> str:
    """The page as text; the same runs and probes give the same text. See `write_label_report`."""
    names = full_names(runs)
    places = tuple(path for run in runs for path in (run.location.address, str(run.location)))
    sections = label_sections(runs, table, names, places)
    summary = table.summary
    sentence, bibtex = citation(runs)
    return render(
        "labels.html.jinja",
        places,
        title=", ".join(table.targets),
        suites=list(dict.fromkeys(run.suite for run in runs)),
        version=__version__,
        several=len(runs) > 1,
        summary=summary,
        sentences=table.sentences,
        labels=sections,
        provenance=[
            provenance(name, run, None, [table.results[str(run.location), target] for target in table.targets])
            for name, run in zip(names, runs, strict=True)
        ],
        words=words_of([summary, *(part for section in sections for part in section.tables)]),
        sentence=sentence,
        bibtex=bibtex,
    )
