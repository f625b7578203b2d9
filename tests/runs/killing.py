"""A process that extracts synthetic episodes through the real writer, to be killed.

Usage: python -m tests.runs.killing RUN SUITE [POINT], in the root of the repository.

It loads no model, so that a kill takes seconds. POINT is where it kills itself: before-put, after-put,
before-commit or after-commit of the third episode it writes.
"""

import os
import signal
import sys
from pathlib import Path

import numpy as np
from zarr.core.buffer import Buffer

from probe_kit.extract.rollout.capturing import EpisodeBuffers
from probe_kit.runs import verify, writer
from probe_kit.runs.array_store import ArrayStore
from probe_kit.runs.commits import Commit
from probe_kit.runs.layout import StoredStream
from probe_kit.runs.plan import Plan
from probe_kit.runs.store import Location, locate
from probe_kit.suite import load_suite
from tests.support.plans import make_plan

STREAMS = [
    StoredStream("backbone", 4, 64, None, 150, ("mean", "last")),
    StoredStream("expert", 3, 32, 5, 20, ("mean",)),
]
SETTINGS = {"captured_calls": 1, "tokens": "all", "codec": "zstd", "model": "synthetic"}


def plan_for(suite: Path) -> Plan:
    return make_plan(load_suite(suite), STREAMS, 0, 1, True)


def rollout(plan: Plan, number: int) -> writer.EpisodeRecord:
    """The same numbers for the same episode, always."""
    draw = np.random.default_rng(number)
    buffers = EpisodeBuffers(STREAMS, 1, True, pinned=False)
    for stream in STREAMS:
        buffers.pooled[stream.name][:] = draw.normal(size=buffers.pooled[stream.name].shape)
        buffers.tokens[stream.name][:] = draw.integers(0, 1 << 16, buffers.tokens[stream.name].shape)
    buffers.roles.append({stream.name: [("language", 0, stream.tokens)] for stream in STREAMS})
    return buffers.record(plan.episodes[number], {"outcome": "oob"}, control_steps=range(len(buffers.roles)))


def extract(run: str, plan: Plan) -> None:
    """What an extraction does with its episodes."""
    writing = writer.RunWriter(locate(run), plan, SETTINGS)
    with writing.claim(), writing.location.explained_errors():
        for number in writing.remaining():
            writing.write(rollout(plan, number))
        verify.seal(run)


def die_at(point: str) -> None:
    """Arrange for a SIGKILL before or after an object or a commit of the third episode is written."""
    when, what = point.split("-")
    put, commit = ArrayStore.set, writer.write_commit
    calls = {"put": 0, "commit": 0}

    def reached(moment: str, call_name: str) -> None:
        if (moment, call_name, calls[call_name]) == (when, what, FATAL[call_name]):
            os.kill(os.getpid(), signal.SIGKILL)

    async def deadly_put(store: ArrayStore, key: str, value: Buffer) -> None:
        calls["put"] += "/c/" in key
        reached("before", "put")
        await put(store, key, value)
        reached("after", "put")

    def deadly_commit(location: Location, content: Commit) -> bool:
        calls["commit"] += 1
        reached("before", "commit")
        written = commit(location, content)
        reached("after", "commit")
        return written

    ArrayStore.set = deadly_put
    writer.write_commit = deadly_commit


# Of four objects and one commit per episode.
FATAL = {"put": 10, "commit": 3}


if __name__ == "__main__":
    run, suite = sys.argv[1], Path(sys.argv[2])
    if len(sys.argv) > 3:
        die_at(sys.argv[3])
    extract(run, plan_for(suite))
