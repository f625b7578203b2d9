"""Checks of what is stored of a study: bytes that were changed, and runs that a study no longer uses."""

from pathlib import Path

from probe_kit.runs import verify_run
from probe_kit.runs.layout import RUN_FILE
from probe_kit.runs.store import locate
from probe_kit.study.planning.plan import StudyPlan


def changed_runs(plan: StudyPlan) -> dict[str, tuple[str, ...]]:
    """By the name of a stored run, what is wrong with it: every byte is compared with its hash."""
    audits = {
        one.cell.name: verify_run(one.location, deep=True)
        for one in plan.played
        if locate(one.location).exists(RUN_FILE)
    }
    return {name: audit.problems for name, audit in audits.items() if not audit.ok}


def orphaned_runs(plan: StudyPlan) -> list[str]:
    """Folders of runs below the study's folder that no run of the file is, such as those of former settings.

    Another study with the same folder may use them. Of a folder on this machine; none are found at a URL.
    """
    out = plan.study.study.folder
    used = {Path(cell.location(out)) for cell in plan.study.cells}
    found = () if "://" in out else Path(out).glob(f"*/*/{RUN_FILE}")
    return sorted(str(file.parent) for file in found if file.parent not in used)
