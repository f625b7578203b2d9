from pathlib import Path

import numpy as np
import pytest

from probe_kit.extract.rollout.capturing import EpisodeBuffers
from probe_kit.extract.rollout.worker import Rollout
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.runs import open_run, seal, verify_run
from probe_kit.runs.layout import StoredStream
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import Suite
from tests.support.plans import make_plan

STREAM = StoredStream("backbone", 2, 8, None, 300, ("mean", "last"))
SETTINGS = {"captured_calls": 1, "tokens": "all", "codec": "zstd", "model": "synthetic"}


@pytest.fixture
def writer(small_suite: Suite, tmp_path: Path) -> RunWriter:
    return RunWriter(locate(tmp_path / "run"), make_plan(small_suite, [STREAM], 0, 1, True), SETTINGS)


def rollout(writer: RunWriter, number: int, language: int) -> Rollout:
    """Ones on the first `language` tokens, padding after them."""
    buffers = EpisodeBuffers([STREAM], 1, True, pinned=False)
    buffers.pooled["backbone"][:] = 1
    buffers.tokens["backbone"][..., :language, :] = 0x3F80
    spans = [("language", 0, language), ("padding", language, 300)]
    buffers.roles.append({"backbone": spans if language else spans[1:]})
    return Rollout(
        writer.plan.episodes[number], {"outcome": "oob"}, buffers, [], control_steps=range(len(buffers.roles))
    )


def test_a_stored_stream_gives_back_all_that_the_model_declared() -> None:
    declared = Stream("expert", 3, 8, 10, "action", "the expert", ("residual", "mlp"), probed=False, sums=False)
    stored = StoredStream.of(declared, 5, ("mean",))
    assert stored.stream == StoredStream.from_json(stored.to_json()).stream == declared


def test_a_block_of_padding_and_an_empty_row_are_stored_and_not_merely_missing(writer: RunWriter) -> None:
    full, empty = rollout(writer, 0, 20), rollout(writer, 1, 20)
    empty.buffers.clear()
    empty.buffers.roles.append(full.buffers.roles[0])
    writer.write(full.record)
    writer.write(empty.record)
    seal(writer.location)
    run = open_run(writer.location, allow_partial=True)
    column = run.column(Site("backbone", 1))
    assert (column[0] == 1).all()
    assert np.isnan(column[1]).all()
    np.testing.assert_array_equal(run.rows("backbone", "tokens").read(0, (0, 1, slice(256, 384))), 0)
    assert verify_run(writer.location, deep=True).ok


def test_only_blocks_of_a_role_are_read(writer: RunWriter) -> None:
    for number, language in enumerate((20, 140)):
        writer.write(rollout(writer, number, language).record)
    run = open_run(writer.location, allow_partial=True)
    blocks = list(run.iter_token_blocks(Site("backbone", 0), "language"))
    assert [block.start for block in blocks] == [0, 128]
    np.testing.assert_array_equal(sum(block.mask.sum(axis=1) for block in blocks), [20, 140])
    np.testing.assert_allclose(
        run.gram(Site("backbone", 0)), 8 * np.array([[1, 20 / 2800**0.5], [20 / 2800**0.5, 1]])
    )


def test_a_second_commit_of_the_same_episode_changes_nothing(writer: RunWriter) -> None:
    writer.write(rollout(writer, 0, 20).record)
    commit = writer.location.read("commits/00000000.json")
    writer.write(rollout(writer, 0, 20).record)
    assert writer.location.read("commits/00000000.json") == commit
    assert verify_run(writer.location, deep=True).ok
