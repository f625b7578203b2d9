"""`run verify --deep` refuses whatever a reader of the run would refuse."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from probe_kit.errors import ProbeKitError
from probe_kit.runs import verify_run
from tests.support.reading import readings
from tests.support.rehashing import write_record

Change = Callable[[Path], object]


def move(source: str, target: str) -> Change:
    """Move the first bundle of a home into another."""

    def change(run: Path) -> None:
        bundle = next(path for path in sorted((run / source).iterdir()) if not path.name.startswith("."))
        (run / target).mkdir(exist_ok=True)
        bundle.rename(run / target / bundle.name)

    return change


def edited(home: str, name: str, value: object) -> Change:
    """Change one setting of the first bundle of a home, under a right hash."""

    def change(run: Path) -> None:
        head = next(path for path in sorted((run / home).glob("*/settings.json")))
        content = json.loads(head.read_text(encoding="utf-8"))
        content["settings"][name] = value
        write_record(head, content)

    return change


@pytest.mark.parametrize(
    "change",
    [
        move("probes", "interventions"),
        pytest.param(move("interventions", "probes"), marks=pytest.mark.slow),
        edited("probes", "format", 99),
        pytest.param(edited("probes", "seed", 17), marks=pytest.mark.slow),
        pytest.param(edited("probes", "run_settings", "0" * 64), marks=pytest.mark.slow),
        pytest.param(edited("interventions", "format", 99), marks=pytest.mark.slow),
        edited("interventions", "kind", "no-such-kind"),
        edited("interventions", "seed", 17),
    ],
    ids=[
        "probes among interventions", "interventions among probes", "format of probes", "key of probes",
        "probes of another run", "format of an intervention", "kind of an intervention", "key of an intervention",
    ],
)  # fmt: skip
def test_a_result_that_no_reader_takes_is_a_problem(little_runs: Path, tmp_path: Path, change: Change) -> None:
    run = Path(shutil.copytree(little_runs / "run", tmp_path / "run"))
    assert verify_run(run, deep=True).problems == ()
    change(run)
    with pytest.raises(ProbeKitError):
        readings(run)
    assert verify_run(run, deep=True).problems
