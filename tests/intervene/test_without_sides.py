"""Interventions on recordings: pairs of frames that differ in one input, read toward the donor's action."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import OtherFramesError, UsageError
from probe_kit.extract import ExtractSettings, LeRobotSource, extract_run
from probe_kit.hooks import Observation
from probe_kit.intervene import AttributionPatching, ImageSwap, Interchange, ReplayFiles, run_intervention
from probe_kit.intervene.frame_session import FrameSession
from probe_kit.intervene.open_session import open_session
from probe_kit.intervene.outcomes import displacements_toward, sizes, spread_of
from probe_kit.intervene.pairs import Pair, read_pairs
from probe_kit.intervene.replay import replay
from probe_kit.intervene.scene_session import SceneSession
from probe_kit.runs import Run, open_run
from tests.intervene.answers import patches_of
from tests.support.lerobot_recordings import CAMERA, write_recording

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

ITEMS = 3


@pytest.fixture(scope="module")
def scene_pairs(session: SceneSession) -> list[Pair]:
    """Both layouts of some items: the other layout is the donor of each."""
    items = list(dict.fromkeys(session.run.episodes["item_id"].astype(str)))[:ITEMS]
    return [pair for item in items for pair in session.pairs(item)]


@pytest.fixture(scope="module")
def shown_run(scene_pairs: list[Pair], tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run on recordings whose episodes are the first frames of the scene, one frame each."""
    pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="the extra `datasets` is not installed")
    folder = tmp_path_factory.mktemp("recorded")
    frames = [pair.clean for pair in scene_pairs]
    assert all(isinstance(frame, Observation) for frame in frames)
    write_recording(folder / "frames", [[frame] for frame in frames])  # type: ignore[list-item]
    source = LeRobotSource(str(folder / "frames"), cameras={"base": CAMERA})
    return extract_run(ExtractSettings("pi0-tiny", source=source, random_weights=True), folder / "run")


@pytest.fixture(scope="module")
def table(shown_run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every frame with the other layout of its item."""
    file = tmp_path_factory.mktemp("pairs") / "pairs.csv"
    rows = [f"{at},0,{at ^ 1},0" for at in range(len(shown_run.episodes))]
    file.write_text("\n".join(["episode,frame,donor_episode,donor_frame", *rows]), encoding="utf-8")
    return file


@pytest.fixture
def observed(shown_run: Run, table: Path, twin: "Policy") -> Iterator[FrameSession]:
    choice = ImageSwap(pairs=read_pairs(table))
    with open_session(shown_run, ReplayFiles(), lambda *_: twin, choice) as opened, opened.ready():
        assert isinstance(opened, FrameSession)
        yield opened


@pytest.mark.slow
def test_recordings_of_scene_frames_give_the_numbers_of_the_scene_bit_for_bit(
    session: SceneSession, scene_pairs: list[Pair], observed: FrameSession
) -> None:
    """Same frames and seeds: the chunks, the displacements toward the source and the shares of patches."""
    recorded = [pair for item in observed.items for pair in observed.pairs(item)]
    seeded = [
        replace(pair, seed=scene_pair.seed, stored=None)
        for pair, scene_pair in zip(recorded, scene_pairs, strict=True)
    ]
    for pair, scene_pair in zip(seeded, scene_pairs, strict=True):
        assert isinstance(pair.clean, Observation)
        assert isinstance(scene_pair.source, Observation)
        assert isinstance(pair.source, Observation)
        np.testing.assert_array_equal(pair.source.image, scene_pair.source.image)
        np.testing.assert_array_equal(pair.clean.state, scene_pair.source.state)
    interchange = Interchange(sites=("backbone.01", "kv.01"), roles=("all", "image"))
    seeded = seeded[:4]  # both layouts of two items
    batches = [
        replay(opened, pairs[:4], interchange.conditions(opened))
        for opened, pairs in ((session, scene_pairs), (observed, seeded))
    ]
    scene, frames = (batch.in_spreads() for batch in batches)
    assert batches[0].chunks is not None
    assert batches[1].chunks is not None
    np.testing.assert_array_equal(batches[0].chunks, batches[1].chunks)
    np.testing.assert_array_equal(scene.toward, frames.toward)
    np.testing.assert_array_equal(frames.displacement, frames.toward)
    assert scene.toward is not None
    assert not np.array_equal(scene.displacement, scene.toward), "in the scene also metres"
    groups = np.arange(len(seeded)).astype(str)
    rows = [
        patches_of(replace(outcomes, groups=groups, categories=np.full(len(seeded), "all")), "seed")
        for outcomes in (scene, frames)
    ]
    assert [row.action_share for row in rows[0]] == [row.action_share for row in rows[1]]
    assert all(row.action_share is not None for row in rows[0])


@pytest.mark.slow
def test_a_swap_of_pictures_is_stored_and_read_again(shown_run: Run, table: Path, twin: "Policy") -> None:
    swap = ImageSwap(pairs=read_pairs(table))
    result = run_intervention(shown_run, swap, load=lambda *_: twin)
    (row,) = result.effects
    assert (row.vary, row.n_episodes, row.n_items) == ("picture", 2 * ITEMS, 2 * ITEMS)
    assert row.share == pytest.approx(1.0), "only the pictures differ in these pairs"
    assert row.size == row.full_size > 0
    assert row.is_of_the_seed, "the network is untrained"
    assert row.finding != "decides", "a share of next to nothing"
    assert "the seed decides it" in result.findings[0]
    again = run_intervention(shown_run, swap, load=not_loaded)
    assert again.to_csv() == result.to_csv()
    assert result.verdicts == {}
    assert "the picture" in result.sentences[0]
    assert result.to_rich() is not None
    assert run_intervention(shown_run, ImageSwap(), load=lambda *_: twin).key != result.key, "other pairs"


def not_loaded(*_: object) -> "Policy":
    raise AssertionError("it is stored")


@pytest.mark.parametrize(
    ("words", "mention"),
    [
        (("--kind", "closed-loop", "--sites", "backbone.02"), "closed-loop"),
        (("--kind", "erase", "--sites", "backbone.02"), "erase"),
        (("--readout", "per-step"), "per-step"),
        (("--vary", "smell"), "expected one of instruction, picture, picture.base, state"),
        (("--kind", "steer", "--sites", "backbone.02", "--roles", "image"), "no direction there"),
    ],
)
def test_kinds_that_need_sides_are_refused_by_name_for_a_run_without_sides(
    shown_run: Run, words: tuple[str, ...], mention: str
) -> None:
    answer = CliRunner().invoke(app, ["intervene", str(shown_run.path), *words], env={"COLUMNS": "200"})
    assert answer.exit_code == 2
    assert mention in " ".join(answer.stderr.split())


@pytest.mark.slow
def test_a_frame_with_two_donors_is_read_toward_each_of_them(shown_run: Run, table: Path, twin: "Policy") -> None:
    choice = ImageSwap(pairs=(*read_pairs(table), ("episode-000000", 0, "episode-000004", 0)))
    with open_session(shown_run, ReplayFiles(), lambda *_: twin, choice) as opened, opened.ready():
        assert isinstance(opened, FrameSession)
        near, far = (pair for pair in opened.pairs(opened.items[0]) if pair.row == 0)
        for pair in (near, far):
            apart = (opened.act(pair.source, pair.seed) - opened.act(pair.clean, pair.seed)).astype(float).ravel()
            varied = int((opened.weights > 0).sum())
            size = np.sqrt((apart**2 * opened.weights).sum() / varied)
            assert size > 0
            assert opened.displacement(opened.act(pair.source, pair.seed), pair) == pytest.approx(size, rel=1e-5)


def test_pairs_are_refused_in_the_scene(copy: Run, table: Path) -> None:
    with pytest.raises(UsageError, match="--vary, --frames, --pairs and --instructions"):
        ImageSwap(pairs=read_pairs(table)).check_run(copy)


def test_recordings_that_were_changed_or_moved_are_refused(shown_run: Run, observed: FrameSession) -> None:
    run = open_run(shown_run.path)
    run.__dict__["origins"] = (replace(shown_run.origins[0], files={}),)
    with pytest.raises(UsageError, match="--dataset"):
        open_session(run, ReplayFiles())
    frame = observed.frames.index[0]
    run.episodes.loc[0, "content_blake2b"] = "0" * 32
    observed.frames.run = run
    with pytest.raises(OtherFramesError, match="not those of"):
        type(observed.frames).observe(observed.frames, frame)  # not the cached one


@pytest.mark.parametrize(
    ("text", "mention"),
    [
        ("episode,frame\n0,0", "donor_episode"),
        ("episode,frame,donor_episode,donor_frame\n0,zero,1,0", "number of a frame"),
        ("episode,frame,donor_episode,donor_frame\n", "names no pair"),
    ],
)
def test_a_table_that_names_no_pairs_is_refused_with_its_line(tmp_path: Path, text: str, mention: str) -> None:
    file = tmp_path / "pairs.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=mention):
        read_pairs(file)


def test_displacements_are_shares_of_the_source_and_flat_numbers_do_not_count() -> None:
    """Against the definition, written out number by number."""
    draw = np.random.default_rng(0)
    chunks = draw.normal(size=(3, 5, 4)).astype(np.float32)
    chunks[..., 3] = 0.25  # a number without spread
    chunks[2] = chunks[0] + np.float32(0.5) * (chunks[1] - chunks[0])
    assert spread_of(chunks[0])[3] == 0
    spread = chunks[0].astype(np.float64)[:, :3].std(axis=0)
    apart = (chunks[1].astype(np.float64) - chunks[0])[:, :3] / spread
    toward = displacements_toward(chunks, 1)
    np.testing.assert_allclose(toward[1], np.sqrt((apart**2).mean(axis=1)))
    np.testing.assert_allclose(toward[2], toward[1] / 2, rtol=1e-6)
    np.testing.assert_allclose(sizes(chunks)[1], toward[1])
    assert not toward[0].any()


@pytest.mark.slow
def test_a_table_and_a_command_give_the_same_rows(shown_run: Run, table: Path, twin: "Policy") -> None:
    result = run_intervention(shown_run, ImageSwap(pairs=read_pairs(table)), load=lambda *_: twin)
    answer = CliRunner().invoke(app, ["intervene", str(shown_run.path), "--pairs", str(table), "--format", "json"])
    assert answer.exit_code == 0, answer.stderr
    assert json.loads(answer.stdout)["key"] == result.key


@pytest.mark.slow
def test_estimates_by_gradients_are_kept_where_nothing_has_a_side(
    shown_run: Run, table: Path, twin: "Policy"
) -> None:
    """An estimate adds to the clean action's displacement, which no inference shows."""
    screen = AttributionPatching(pairs=read_pairs(table), sites=("backbone.00",), roles=("image",))
    result = run_intervention(shown_run, screen, load=lambda *_: twin)
    (estimates,) = (
        row
        for name, row in zip(result.outcomes.conditions, result.outcomes.displacement, strict=True)
        if name == "estimate|backbone.00|image"
    )
    assert np.abs(estimates).min() > 0
