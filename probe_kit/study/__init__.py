"""Studies: models × categories × conditions from one file."""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names

if TYPE_CHECKING:
    from probe_kit.study.cells import StudyFailure
    from probe_kit.study.drift import CategoryDrift, measure_drift
    from probe_kit.study.pack import pack_study, publish_data_set, write_data_set
    from probe_kit.study.plan import StudyPlan, plan_study
    from probe_kit.study.playing import EpisodeStored, RunFinished, conduct_study, fit_probes
    from probe_kit.study.reading import LoadedStudy, load_study
    from probe_kit.study.report import make_figures, write_study_report
    from probe_kit.study.schema import Mistake, StudyFileError
    from probe_kit.study.tables import make_table

__all__ = [
    "CategoryDrift",
    "EpisodeStored",
    "LoadedStudy",
    "Mistake",
    "RunFinished",
    "StudyFailure",
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
    "write_study_report",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "LoadedStudy": "reading",
        "load_study": "reading",
        "Mistake": "schema",
        "StudyFileError": "schema",
        "CategoryDrift": "drift",
        "measure_drift": "drift",
        "make_figures": "report",
        "pack_study": "pack",
        "publish_data_set": "pack",
        "write_data_set": "pack",
        "write_study_report": "report",
        "StudyPlan": "plan",
        "plan_study": "plan",
        "StudyFailure": "cells",
        "RunFinished": "playing",
        "EpisodeStored": "playing",
        "conduct_study": "playing",
        "fit_probes": "playing",
        "make_table": "tables",
    },
)
