"""How much processor time a training took."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage


@contextmanager
def timed(out: Path, part: str) -> Iterator[None]:
    """Adds to what `time.json` says about a part, in minutes of all processes; of a stopped part it is lost."""
    file = out / "time.json"
    processor, wall = _processor_seconds(), time.monotonic()
    yield
    spent = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    before = spent.get(part, {"processor": 0.0, "wall": 0.0})
    now = {"processor": (_processor_seconds() - processor) / 60, "wall": (time.monotonic() - wall) / 60}
    spent[part] = {name: round(before[name] + now[name], 2) for name in now}
    file.write_text(json.dumps(spent, indent=1), encoding="utf-8")


def _processor_seconds() -> float:
    """Of this process and of those it waited for."""
    used = [getrusage(whose) for whose in (RUSAGE_SELF, RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)
