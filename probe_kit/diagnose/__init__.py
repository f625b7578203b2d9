"""Why a policy ignores an input: does it arrive, does it matter, and where on the way to the action is it lost?

`frames` draws observations of a run. `measure` exchanges their inputs, which `inputs` names. `importance` measures
how much of the action an input decides, `passage` at which sites it passes. `diagnosis` does all of it on a run,
and stores it there.
"""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names

if TYPE_CHECKING:
    from probe_kit.diagnose.diagnosis import diagnose_run, load_diagnosis
    from probe_kit.diagnose.page import draw_passage, write_page
    from probe_kit.diagnose.results import Diagnosis
    from probe_kit.diagnose.sentences import diagnosis_table

__all__ = ["Diagnosis", "diagnose_run", "diagnosis_table", "draw_passage", "load_diagnosis", "write_page"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Diagnosis": "results",
        "diagnose_run": "diagnosis",
        "load_diagnosis": "diagnosis",
        "diagnosis_table": "sentences",
        "draw_passage": "page",
        "write_page": "page",
    },
)
