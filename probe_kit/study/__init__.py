"""Studies: models × categories × conditions from one file."""

from typing import TYPE_CHECKING

from probe_kit._system.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.study.drift.measures import CategoryDrift, measure_drift
    from probe_kit.study.figures import make_figures
    from probe_kit.study.ledger import Failure, Ledger
    from probe_kit.study.mistakes import Mistake, StudyFileError
    from probe_kit.study.packing.data_set import write_data_set
    from probe_kit.study.packing.pack import pack_study
    from probe_kit.study.packing.publishing import publish_data_set
    from probe_kit.study.packing.report import write_study_report
    from probe_kit.study.planning.plan import StudyPlan, plan_study
    from probe_kit.study.reading import LoadedStudy, load_study
    from probe_kit.study.running.calibrating import calibrate_study
    from probe_kit.study.running.conduct import conduct_study
    from probe_kit.study.running.model_task import Made, Moved
    from probe_kit.study.running.probing import fit_probes
    from probe_kit.study.tables.make import make_table
    from probe_kit.study.tables.named_table import NamedTable

__all__ = [
    "CategoryDrift",
    "Failure",
    "Ledger",
    "LoadedStudy",
    "Made",
    "Mistake",
    "Moved",
    "NamedTable",
    "StudyFileError",
    "StudyPlan",
    "calibrate_study",
    "conduct_study",
    "fit_probes",
    "load_study",
    "make_figures",
    "make_table",
    "measure_drift",
    "pack_study",
    "plan_study",
    "publish_data_set",
    "write_data_set",
    "write_study_report",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "LoadedStudy": "reading",
        "load_study": "reading",
        "Mistake": "mistakes",
        "StudyFileError": "mistakes",
        "CategoryDrift": "drift.measures",
        "measure_drift": "drift.measures",
        "make_figures": "figures",
        "pack_study": "packing.pack",
        "publish_data_set": "packing.publishing",
        "write_data_set": "packing.data_set",
        "write_study_report": "packing.report",
        "StudyPlan": "planning.plan",
        "plan_study": "planning.plan",
        "Failure": "ledger",
        "Ledger": "ledger",
        "Made": "running.model_task",
        "Moved": "running.model_task",
        "calibrate_study": "running.calibrating",
        "conduct_study": "running.conduct",
        "fit_probes": "running.probing",
        "NamedTable": "tables.named_table",
        "make_table": "tables.make",
    },
)
