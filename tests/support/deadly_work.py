"""Work that ends its process, for tests whose children find this module by its name."""

import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from probe_kit.study.playing import ModelTask, play_here


@dataclass(frozen=True)
class DeadlyProblem:
    """A problem whose first `kills` fits kill their process. folder: of the files that count them."""

    problem: Any
    folder: Path
    kills: int

    def probe(self, samples: Any) -> Any:
        for kill in range(self.kills):
            mark = self.folder / str(kill)
            if not mark.exists():
                mark.touch()
                os.kill(os.getpid(), signal.SIGKILL)
        return self.problem.probe(samples)


def play_but_the_first(setup: None, take: Callable[[], ModelTask], report: Callable[[Any], None]) -> None:
    """As `play_here`, but the model `first` ends its process with code 7."""

    def take_warily() -> ModelTask:
        task = take()
        if task.model == "first":
            sys.exit(7)
        return task

    play_here(setup, take_warily, report)


def stillborn(_setup: None, _take: object, _report: object) -> None:
    """Ends at once."""
    sys.exit(7)
