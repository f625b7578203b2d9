"""Studies: models × categories × conditions from one file."""

from typing import TYPE_CHECKING

from probe_kit._system.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.study.conduct import ModelFailure, conduct_study
    from probe_kit.study.drift.measures import CategoryDrift, measure_drift
    from probe_kit.study.figures import make_figures
    from probe_kit.study.mistakes import Mistake, StudyFileError
    from probe_kit.study.packing.data_set import write_data_set
    from probe_kit.study.packing.pack import pack_study
    from probe_kit.study.packing.publishing import publish_data_set
    from probe_kit.study.plan import StudyPlan, plan_study
    from probe_kit.study.probing import ProbeFailure, fit_probes
    from probe_kit.study.reading import LoadedStudy, load_study
    from probe_kit.study.tables.make import make_table
    from probe_kit.study.tables.named_table import NamedTable

__all__ = [
    "CategoryDrift",
    "LoadedStudy",
    "Mistake",
    "ModelFailure",
    "NamedTable",
    "ProbeFailure",
    "StudyFileError",
    "StudyPlan",
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
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "LoadedStudy": "reading",
        "load_study": "reading",
        "Mistake": "mistakes",
        "StudyFileError": "mistakes",
        "StudyPlan": "plan",
        "plan_study": "plan",
        "ModelFailure": "conduct",
        "conduct_study": "conduct",
        "ProbeFailure": "probing",
        "fit_probes": "probing",
        "CategoryDrift": "drift.measures",
        "measure_drift": "drift.measures",
        "make_figures": "figures",
        "pack_study": "packing.pack",
        "publish_data_set": "packing.publishing",
        "write_data_set": "packing.data_set",
        "NamedTable": "tables.named_table",
        "make_table": "tables.make",
    },
)
