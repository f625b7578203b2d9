"""Diagnosis of a policy that ignores an input: does it arrive, does it matter, and where on the way is it lost?

`inputs` draws frames of a run and names their inputs. `measure` exchanges inputs between frames and infers the
actions. `importance` computes how much of the action an input decides. `diagnosis` finds the sites at which an
input passes, and stores all of it.
"""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names

if TYPE_CHECKING:
    from probe_kit.diagnose.diagnosis import diagnose_run, load_diagnosis
    from probe_kit.diagnose.page import draw_passage, write_page
    from probe_kit.diagnose.results import Diagnosis, diagnosis_table

__all__ = ["Diagnosis", "diagnose_run", "diagnosis_table", "draw_passage", "load_diagnosis", "write_page"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Diagnosis": "results",
        "diagnose_run": "diagnosis",
        "load_diagnosis": "diagnosis",
        "diagnosis_table": "results",
        "draw_passage": "page",
        "write_page": "page",
    },
)
