"""Tables of a study in an experiment tracker, MLflow or Weights & Biases, made from stored runs alone."""

import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from probe_kit._system.optional_dependencies import require
from probe_kit.errors import UsageError
from probe_kit.hashing import sha256_text
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.tables.formats import markdown_text, table_record
from probe_kit.study.tables.make import make_table
from probe_kit.study.tables.named_table import NamedTable

Tracker = Literal["mlflow", "wandb"]
TRACKERS: tuple[Tracker, ...] = get_args(Tracker)
VERSION_TAG = "probe_kit.study"
_NO_NAME = re.compile(r"[^\w\-. :/]+")


@dataclass(frozen=True)
class TrackedStudy:
    """The tables of a study by name, and the hash of all of them and of the file (hexadecimal)."""

    name: str
    version: str
    file: str
    tables: Mapping[str, NamedTable]

    @classmethod
    def of(cls, study: LoadedStudy, partial: bool = False) -> "TrackedStudy":
        """All tables of the file. partial, and what is raised: as of `make_table`."""
        tables = {name: make_table(study, name, partial) for name in study.study.tables}
        file = json.dumps(study.study.model_dump(mode="json", exclude_defaults=True), indent=1)
        made = json.dumps({name: table_record(one) for name, one in tables.items()}, sort_keys=True)
        return cls(study.study.name, sha256_text(f"{file}\n{made}"), file, tables)

    def metrics(self) -> dict[str, float]:
        """Every number, named by its table, the words beside it and its own name, such as
        `success/π0-tiny/color/sr`."""
        return {
            _NO_NAME.sub("_", "/".join([table, *_words(row), name])): value
            for table, one in self.tables.items()
            for row in one.numbers
            for name, value in _values(row)
        }


def track_study(
    study: LoadedStudy, tracker: Tracker, project: str = "probe-kit", partial: bool = False
) -> tuple[str, bool]:
    """Log every table of a study as one run of a project; returns the run's id, and whether it is new.

    The tracker's own settings say where it logs to (`MLFLOW_TRACKING_URI`, `WANDB_MODE`, …). The same tables are
    not logged twice: the run is found by their hash, on W&B by its id. Raises MissingExtraError, UsageError for an
    unknown tracker, and what `make_table` raises.
    """
    if tracker not in _LOGGERS:
        raise UsageError(f"there is no tracker {tracker!r}; choose {' or '.join(TRACKERS)}")
    return _LOGGERS[tracker](TrackedStudy.of(study, partial), project)


def _words(row: Mapping[str, Any]) -> Iterator[str]:
    """What says whose numbers a row has; a location is no name."""
    return (value for name, value in row.items() if isinstance(value, str) and value and name != "run")


def _values(row: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for name, value in row.items():
        if isinstance(value, int | float):
            yield name, float(value)
        elif isinstance(value, list | tuple) and len(value) == 2 and None not in value:
            yield from ((f"{name}_low", float(value[0])), (f"{name}_high", float(value[1])))


def _log_to_mlflow(tracked: TrackedStudy, project: str) -> tuple[str, bool]:
    mlflow = require("mlflow", "trackers")
    experiment = mlflow.set_experiment(project).experiment_id
    wanted = f"tags.`{VERSION_TAG}` = '{tracked.version}' and attributes.status = 'FINISHED'"
    found = mlflow.MlflowClient().search_runs([experiment], wanted, max_results=1)
    if found:
        return str(found[0].info.run_id), False
    with mlflow.start_run(
        experiment_id=experiment, run_name=tracked.name, tags={VERSION_TAG: tracked.version}
    ) as run:
        mlflow.log_metrics(tracked.metrics())
        mlflow.log_text(tracked.file, "study.json")
        for name, table in tracked.tables.items():
            mlflow.log_text(markdown_text(table), f"tables/{name}.md")
            mlflow.log_dict(table_record(table), f"tables/{name}.json")
    return str(run.info.run_id), True


def _log_to_wandb(tracked: TrackedStudy, project: str) -> tuple[str, bool]:
    """The hash is the run's id: a second call continues the same run."""
    wandb = require("wandb", "trackers")
    with wandb.init(
        project=project,
        id=tracked.version[:16],
        name=tracked.name,
        resume="allow",
        config={VERSION_TAG: tracked.version, "study": json.loads(tracked.file)},
    ) as run:
        if run.resumed and run.summary.get(VERSION_TAG) == tracked.version:
            return str(run.id), False
        for name, table in tracked.tables.items():
            rows = [list(cells) for cells in table.text.cells]
            run.log({f"tables/{name}": wandb.Table(columns=_unlike(table.text.columns), data=rows)})
        run.summary.update({**tracked.metrics(), VERSION_TAG: tracked.version})
    return str(run.id), True


def _unlike(names: tuple[str, ...]) -> list[str]:
    """Names of columns, each once: a second one of a name is numbered."""
    return [
        f"{name} {before + 1}" if (before := names[:at].count(name)) else name for at, name in enumerate(names)
    ]


_LOGGERS: Mapping[Tracker, Callable[[TrackedStudy, str], tuple[str, bool]]] = {
    "mlflow": _log_to_mlflow,
    "wandb": _log_to_wandb,
}
