"""What holds of every run, whatever its shape and wherever it was interrupted."""

import shutil
import tempfile
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test

from probe_kit.extract.rollout.capturing import EpisodeBuffers
from probe_kit.runs import Run, open_run, seal, verify_run
from probe_kit.runs.layout import StoredStream
from probe_kit.runs.plan import Plan
from probe_kit.runs.run import NotSealedWarning
from probe_kit.runs.store import locate
from probe_kit.runs.writer import EpisodeRecord, RunWriter
from probe_kit.suite import Suite
from tests.support.plans import make_plan

STREAMS = st.builds(
    StoredStream,
    name=st.just("backbone"),
    layers=st.integers(1, 3),
    width=st.integers(1, 9),
    iterations=st.none() | st.integers(1, 3),
    tokens=st.sampled_from([1, 5, 127, 128, 129, 200]),
    views=st.sampled_from([("mean",), ("mean", "last", "mean:language")]),
)
SLOW = (HealthCheck.too_slow, HealthCheck.function_scoped_fixture)


class KilledError(Exception):
    """Stands for a process that ends here."""


def choices(calls: int, tokens: str, codec: str) -> dict[str, Any]:
    return {"captured_calls": calls, "tokens": tokens, "codec": codec, "model": "synthetic"}


def rollout(plan: Plan, number: int, calls: int) -> EpisodeRecord:
    """The same numbers for the same episode, always; odd ones end after their first inference."""
    draw, (stream,) = np.random.default_rng(number), plan.streams
    buffers = EpisodeBuffers([stream], calls, True, pinned=False)
    for call in range(1 if number % 2 else calls):
        buffers.pooled["backbone"][call] = draw.normal(size=buffers.pooled["backbone"].shape[1:])
        shape = buffers.tokens["backbone"].shape[1:-2]
        buffers.tokens["backbone"][call, ..., : stream.tokens, :] = draw.integers(
            0, 0x7F00, (*shape, stream.tokens, stream.width)
        )
        buffers.roles.append({"backbone": [("language", 0, stream.tokens)]})
    return buffers.record(plan.episodes[number], {"outcome": "oob"}, control_steps=range(len(buffers.roles)))


def assert_reads_as_written(run: Run, plan: Plan, written: list[int], calls: int) -> None:
    """Every view of every site, by columns and by rows, and every token."""
    (stream,) = plan.streams
    stored = [rollout(plan, number, calls).arrays for number in written]
    for site in run.sites("backbone"):
        for call in range(calls):
            for position, view in enumerate(stream.views):
                expected = [
                    episode_arrays["pooled"]["backbone"][(call, *stream.at(site), position)]
                    for episode_arrays in stored
                ]
                np.testing.assert_array_equal(run.column(site, view, call), np.stack(expected))
            bits = np.stack(
                [episode_arrays["tokens"]["backbone"][(call, *stream.at(site))] for episode_arrays in stored]
            )
            values, _ = run.tokens(site, None, call)
            np.testing.assert_array_equal(values, (bits.astype(np.uint32) << 16).view(np.float32))


@pytest.mark.slow
@given(
    stream=STREAMS, calls=st.integers(1, 3), codec=st.sampled_from(["zstd", "fast", "none"]),
    episodes=st.sets(st.integers(0, 11), min_size=1),
)  # fmt: skip
@settings(max_examples=12, deadline=None, suppress_health_check=SLOW)
@pytest.mark.filterwarnings("ignore::probe_kit.runs.run.NotSealedWarning")
def test_columns_equal_rows_equal_what_was_written(
    small_suite: Suite, stream: StoredStream, calls: int, codec: str, episodes: set[int]
) -> None:
    plan = make_plan(small_suite, [stream], 0, calls, True)
    plan = replace(plan, episodes=plan.episodes[:12])
    with tempfile.TemporaryDirectory() as folder:
        writer = RunWriter(locate(Path(folder) / "run"), plan, choices(calls, "all", codec))
        for number in episodes:
            writer.write(rollout(plan, number, calls))
        run = open_run(writer.location, allow_partial=True)
        assert not run.sealed
        assert_reads_as_written(run, plan, sorted(episodes), calls)
        assert seal(writer.location)
        assert not seal(writer.location), "there is nothing left to do"
        run = open_run(writer.location, allow_partial=True)
        assert run.sealed
        assert_reads_as_written(run, plan, sorted(episodes), calls)
        assert verify_run(writer.location, deep=True).ok


class Extraction(RuleBasedStateMachine):
    """A run that is written, killed, resumed, sealed and read in any order, beside a set of numbers."""

    suite: Suite
    stream = StoredStream("backbone", 2, 4, None, 130, ("mean",))
    calls, count = 2, 5

    def __init__(self) -> None:
        super().__init__()
        plan = make_plan(self.suite, [self.stream], 0, self.calls, True)
        self.plan = replace(plan, episodes=plan.episodes[: self.count])
        self.folder = Path(tempfile.mkdtemp())
        self.committed: set[int] = set()
        self.resume()

    @rule()
    def resume(self) -> None:
        """A new process comes along."""
        self.writer = RunWriter(locate(self.folder / "run"), self.plan, choices(self.calls, "all", "zstd"))
        with self.writer.claim():
            self.writer.begin()
            assert self.writer.remaining() == [n for n in range(self.count) if n not in self.committed]
        assert not list((self.folder / "run").rglob("*.tmp")), "leftovers are cleared"

    @rule(number=st.integers(0, 4))
    def write(self, number: int) -> None:
        """Also a second time, which changes nothing."""
        self.writer.write(rollout(self.plan, number, self.calls))
        self.committed.add(number)

    @rule(number=st.integers(0, 4), commits=st.booleans())
    def kill(self, number: int, commits: bool) -> None:
        """The process ends before the commit, with its arrays written, or while it writes aside.

        A committed episode is not written again, so nothing is interrupted.
        """

        def die(*_: object, **__: object) -> None:
            raise KilledError

        where = "write_commit" if commits else "zarr.open_array"
        dies = nullcontext() if number in self.committed else pytest.raises(KilledError)
        with patch(f"probe_kit.runs.writer.{where}", die), dies:
            self.writer.write(rollout(self.plan, number, self.calls))
        (self.folder / "run" / "commits").mkdir(exist_ok=True)
        (self.folder / "run" / "commits" / f"left{number}.tmp").write_text("half a commit", encoding="utf-8")
        self.resume()

    @rule()
    def seal(self) -> None:
        """Columns are built once per set of commits."""
        before = open_run(self.writer.location, allow_partial=True).sealed
        assert seal(self.writer.location) == (bool(self.committed) and not before)

    @invariant()
    def is_whole(self) -> None:
        """Nothing that is committed is ever damaged."""
        assert verify_run(self.writer.location, deep=True).ok

    @precondition(lambda self: self.committed)
    @rule()
    def read(self) -> None:
        """Numbers are those of the committed episodes, in the order of the plan."""
        run = open_run(self.writer.location, allow_partial=True)
        assert run.episodes["episode"].tolist() == sorted(self.committed)
        assert_reads_as_written(run, self.plan, sorted(self.committed), self.calls)

    def teardown(self) -> None:
        """Remove the run."""
        shutil.rmtree(self.folder)


@pytest.mark.filterwarnings(f"ignore::{NotSealedWarning.__module__}.{NotSealedWarning.__name__}")
def test_a_run_is_its_committed_episodes_whatever_happened_on_the_way(small_suite: Suite) -> None:
    machine = type("SuiteExtraction", (Extraction,), {"suite": small_suite})
    run_state_machine_as_test(machine, settings=settings(max_examples=2, stateful_step_count=8, deadline=None))
