"""A log without a terminal: alive, short, and with rates that are so."""

import io

import pytest
from rich.console import Console

from probe_kit._terminal import console
from probe_kit._terminal.console import EVERY, FIRST, Heartbeat, spoken


class Clock:
    seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


def lines_of(steps: list[tuple[float, int]], total: int) -> list[str]:
    """What is said when `done` of `total` are finished at each time."""
    clock, said = Clock(), list[str]()
    beat = Heartbeat("episodes", said.append, clock)
    for seconds, done in steps:
        clock.seconds = seconds
        beat(done, total, "correct")
    return said


def test_the_last_line_is_said_once_however_many_events_bring_the_end() -> None:
    """The eight episodes of one answer of a Ray worker are all counted before the first of them is printed."""
    assert len(lines_of([(1.0, 2), (2.0, 10), (2.0, 10), (2.1, 10), (100.0, 10)], 10)) == 1


def test_long_work_says_a_line_now_and_then_and_one_at_the_end() -> None:
    said = lines_of([(second, second) for second in range(1, 601)], 600)
    assert len(said) == 1 + int((600 - FIRST) // EVERY) + 1
    assert said[0] == "episodes: 10/600 after 10 s, 1.0 per s, about 9 min 50 s left"
    assert said[-1] == "episodes: 600/600 after 10 min 00 s, 1.0 per s"


def test_short_work_says_one_line() -> None:
    assert lines_of([(1.0, 1), (2.0, 2)], 2) == ["episodes: 2/2 after 2 s, 1.0 per s"]


def test_what_an_earlier_process_did_does_not_raise_the_rate() -> None:
    assert lines_of([(30.0, 901), (60.0, 902), (120.0, 904)], 1000)[-1] == (
        "episodes: 904/1000 after 2 min 00 s, 2.0 per min, about 48 min 00 s left"
    )


def test_a_slow_site_is_counted_by_the_hour() -> None:
    assert lines_of([(7200.0, 1), (14400.0, 2)], 3)[-1] == (
        "episodes: 2/3 after 4 h 00 min, 0.5 per h, about 2 h 00 min left"
    )


def test_loading_a_model_is_no_part_of_the_rate() -> None:
    said = lines_of([(40.0, 1), (41.0, 2), (100.0, 61)], 100)
    assert said[0] == "episodes: 1/100 after 40 s"
    assert said[-1] == "episodes: 61/100 after 1 min 40 s, 1.0 per s, about 39 s left"


@pytest.mark.parametrize(("seconds", "words"), [(0.2, "0 s"), (59.6, "1 min 00 s"), (3599.9, "1 h 00 min")])
def test_durations_carry_over(seconds: float, words: str) -> None:
    assert spoken(seconds) == words


@pytest.mark.parametrize("terminal", [True, False])
def test_bars_are_for_terminals_and_lines_for_logs(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = io.StringIO()
    monkeypatch.setattr(console, "err", Console(file=shown, force_terminal=terminal, width=80, markup=False))
    with console.progress() as bar:
        console.counter(bar, "drawing [items]")(3, 3)
    assert ("━" in shown.getvalue()) is terminal
    assert ("drawing [items]: 3/3" in shown.getvalue()) is not terminal
