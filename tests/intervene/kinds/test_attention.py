"""Attention as an intervention that changes nothing: what is noted, stored and said of it."""

import json
import shutil
from dataclasses import replace
from math import ceil
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import CaptureChangedActionError, CaptureError, UnsupportedInterventionError, UsageError
from probe_kit.extract.sources.inputs import picture_of, with_pictures
from probe_kit.hooks import Observation
from probe_kit.hooks.capturing.attention import AttentionMass, capture_attention
from probe_kit.hooks.conformance.subject import example_observations
from probe_kit.hooks.families.smolvla.adapter import SmolVLA
from probe_kit.hooks.registry import find_family
from probe_kit.intervene import (
    AttentionReadout,
    AttentionShares,
    InterventionResult,
    ReplayFiles,
    load_effects,
    run_intervention,
    stored_attention,
)
from probe_kit.intervene.kinds.attention import (
    ATTENTION_FILE,
    PatchAttention,
    attention_recorded,
    shares_by_role,
    stored_patch_attention,
)
from probe_kit.intervene.outcomes import arrays_from_bytes, arrays_to_bytes
from probe_kit.intervene.pairs import Pair
from probe_kit.intervene.places import TILES
from probe_kit.intervene.replay import ConditionContext
from probe_kit.intervene.sessions import ReplaySession
from probe_kit.intervene.tokens import BANDS, patch_embeddings, token_boxes, tokens_overlapping
from probe_kit.runs import Run, open_run, verify_run
from tests.hooks.families.smolvla.checkpoints import write_smolvla
from tests.intervene.answers import follower, measured, outcomes_of, said_of

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


BLOCKS, ITERATIONS, HEADS = 3, 10, 8
STEPS = 4
"""Of the recorded run's episodes."""


@pytest.fixture(scope="module")
def attention_records(copy: Run, source: ReplayFiles, twin: "Policy") -> InterventionResult:
    return run_intervention(copy, AttentionReadout(categories=("color",), items=2), source, load=lambda *_: twin)


@pytest.fixture
def weighed(attention_records: InterventionResult) -> AttentionShares:
    return AttentionShares.from_bytes(attention_records.read(ATTENTION_FILE))


@pytest.mark.slow
def test_it_is_what_the_policy_tells_by_block_iteration_and_head(
    session: ReplaySession, weighed: AttentionShares
) -> None:
    """By hand, on the words of one question."""
    (replay_input, _) = session.pairs(str(weighed.episodes[0]).partition(":")[0])
    row, role = list(weighed.episodes).index(replay_input.episode), weighed.roles.index("language")
    words = session.policy.roles([replay_input.clean])["backbone"][0].mask("language")
    with capture_attention(session.policy) as mass:
        session.act(replay_input.clean, replay_input.seed)
    assert weighed.mass.shape == (4, BLOCKS, ITERATIONS, HEADS, len(weighed.roles))
    for (block, step), weights in mass.by_head.items():
        expected = weights[0][:, words].sum(axis=-1)
        np.testing.assert_allclose(weighed.mass[row, block, step, :, role], expected, rtol=1e-5)
    by_head, by_role_alone = mass.heads_on(words), mass.on(words)
    for read, share in by_head.items():
        np.testing.assert_allclose(share.mean(axis=1), by_role_alone[read])


def test_attention_on_patches_adds_up_to_the_pictures_share_and_patches_lie_where_they_look(
    copy: Run, session: ReplaySession, weighed: AttentionShares
) -> None:
    patches = stored_patch_attention(copy)["color"]
    assert list(patches.episodes) == list(weighed.episodes)
    picture = weighed.mass[..., weighed.roles.index("image")].mean(axis=(2, 3))
    np.testing.assert_allclose(patches.weights.astype(float).sum(axis=2), picture, atol=2e-3)
    (pair, _) = session.pairs(str(weighed.episodes[0]).partition(":")[0])
    assert isinstance(pair.clean, Observation)
    left, top, right, bottom = patches.boxes.T
    assert (left < right).all()
    assert (top < bottom).all()
    height, width = pair.clean.image.shape[:2]
    for side, pixels in pair.tiles.items():
        rows, columns = np.nonzero(pixels)
        on_tile = tokens_overlapping(session.policy, pair.clean, pixels)
        blur = 1 / BANDS
        crosses = ((left - blur) * width <= columns.max()) & ((right + blur) * width > columns.min())
        crosses &= ((top - blur) * height <= rows.max()) & ((bottom + blur) * height > rows.min())
        assert on_tile.any()
        assert crosses[on_tile].all(), side
        assert not crosses.all()
    areas = (right - left) * (bottom - top)
    assert areas.sum() <= 1.2, "patches lie beside each other"


@pytest.mark.slow
def test_every_camera_has_its_patches_where_they_look_and_a_frame_shows_them_side_by_side(tmp_path: Path) -> None:
    cameras = ("top", "wrist")
    policy = SmolVLA.load(str(write_smolvla(tmp_path, cameras=cameras))).with_cameras(cameras)
    (observation,) = example_observations(["Put the cube on the star"], cameras[1:])
    boxes = {camera: token_boxes(policy, observation, camera) for camera in cameras}
    for at, camera in enumerate(cameras):
        pixels = np.zeros(observation.image.shape, bool)
        pixels[:8, :8] = True
        turned = np.where(pixels, 255 - picture_of(observation, camera), picture_of(observation, camera))
        changed = with_pictures(observation, f"picture.{camera}", lambda _, turned=turned: turned)  # type: ignore[misc]
        moved = [
            np.abs(patch_embeddings(policy, changed, name) - patch_embeddings(policy, observation, name)).max(
                axis=1
            )
            for name in cameras
        ]
        assert moved[1 - at].max() == 0, "another camera's patches do not see it"
        strongest = boxes[camera][policy.patch_order()[moved[at].argmax()]]
        assert (strongest[:2] <= 0.15).all(), camera
    roles = ("all", "image.top", "image.wrist")
    session = SimpleNamespace(policy=policy, act=lambda frame, seed: policy.act([frame], [seed])[0])
    context = ConditionContext(session, Pair(observation, observation))  # type: ignore[arg-type]
    result = attention_recorded("backbone", roles, boxes).play(context)
    assert result.patches is not None
    assert result.mass is not None
    counts = [len(places) for places in boxes.values()]
    shares = np.split(result.patches, np.cumsum(counts)[:-1], axis=1)
    for at, of_camera in enumerate(shares, start=1):
        np.testing.assert_allclose(of_camera.sum(axis=1), np.nanmean(result.mass[..., at], axis=(1, 2)), rtol=1e-4)
    stored = PatchAttention(
        np.array(["a"]), np.zeros(1, int), result.patches[None].astype(np.float16),
        np.repeat(cameras, counts), np.concatenate(list(boxes.values())),
    )  # fmt: skip
    stored = PatchAttention(**arrays_from_bytes(arrays_to_bytes(stored)))
    both, first = stored.on_frame(2), stored.on_frame(1)
    np.testing.assert_allclose(both.boxes[: counts[0], 0::2], boxes["top"][:, 0::2] / 2)
    np.testing.assert_allclose(both.boxes[counts[0] :, 0::2], 0.5 + boxes["wrist"][:, 0::2] / 2)
    np.testing.assert_array_equal(both.boxes[:, 1::2], stored.boxes[:, 1::2])
    np.testing.assert_array_equal(first.boxes, boxes["top"])
    np.testing.assert_array_equal(first.weights, stored.weights[..., : counts[0]])


def test_noting_changes_no_action_bit_for_bit(attention_records: InterventionResult) -> None:
    attention_facts = attention_records.certificate["attention"]
    assert (
        attention_facts["inferences"],
        attention_facts["blocks"],
        attention_facts["iterations"],
        attention_facts["heads"],
    ) == (
        4,
        BLOCKS,
        ITERATIONS,
        HEADS,
    )
    assert attention_facts["max_action_change"] == 0.0
    assert attention_records.certificate["replay"]["equal"] == 4
    changed = replace(outcomes_of({"color": follower(4)}), max_action_change=np.full((2, 4), 1e-6))
    with pytest.raises(CaptureChangedActionError, match="1e-06"):
        AttentionReadout().extra_files(SimpleNamespace(), [], changed)  # type: ignore[arg-type]


def test_shares_add_up_and_tiles_are_told_by_where_the_answer_lies(weighed: AttentionShares) -> None:
    shares = weighed.shares()
    assert set(TILES) <= set(weighed.roles)
    np.testing.assert_allclose(shares["all"] + shares["action"], 1)
    summed_shares = sum(shares[role] for role in weighed.roles if role not in ("all", *TILES))
    np.testing.assert_allclose(summed_shares, shares["all"], atol=1e-6)
    np.testing.assert_allclose(
        shares["image.correct"] + shares["image.other"], shares["image.left"] + shares["image.right"]
    )
    is_left = weighed.sides == "left"
    np.testing.assert_array_equal(shares["image.correct"][is_left], shares["image.left"][is_left])
    np.testing.assert_array_equal(shares["image.correct"][~is_left], shares["image.right"][~is_left])
    apart = weighed.correct_minus_other("suite")
    assert set(apart) == set(range(BLOCKS))
    for block, (value, (low, high)) in apart.items():
        difference = shares["image.correct"][:, block] - shares["image.other"][:, block]
        assert value == pytest.approx(difference.mean())
        assert low <= value <= high


def test_means_are_over_what_is_not_asked_for_and_every_episode_counts_alike() -> None:
    """One block is never read; an episode has two calls, the other one."""
    mass = np.arange(3 * 2 * 2 * 2, dtype=np.float32).reshape(3, 2, 2, 2, 1) / 100
    mass[:, 1] = np.nan
    mass[:, 0, 1, :] += np.float32(0.5)
    weighed = AttentionShares(
        ("all",), np.array(["a", "a", "b"]), np.array(["g", "g", "h"]), np.array(["color"] * 3),
        np.array(["left", "left", "right"]), np.array([0, 1, 0]), mass,
    )  # fmt: skip
    (row, _) = weighed.rows(("block",))
    cells = mass[:, 0, :, :, 0].astype(float)
    assert (row.role, row.block, row.iteration, row.n_episodes) == ("all", 0, None, 2)
    assert row.share == pytest.approx((cells[:2].mean() + cells[2].mean()) / 2)
    by_call = weighed.frame(("block", "call")).query("role == 'all'")
    assert by_call["call"].tolist() == [0, 1]
    assert by_call["share"].iloc[1] == pytest.approx(cells[1].mean())
    assert list(weighed.frame(("head",)).columns) == ["category", "role", "head", "share", "n_episodes"]
    assert weighed.correct_minus_other("suite") == {}
    again = AttentionShares.from_bytes(arrays_to_bytes(weighed))
    np.testing.assert_array_equal(again.mass, mass)
    assert arrays_to_bytes(again) == arrays_to_bytes(weighed)
    with pytest.raises(UsageError, match="no axis 'layer'"):
        weighed.rows(("layer",))  # type: ignore[arg-type]


def headings(shares: AttentionShares) -> tuple[str, ...]:
    measurement = measured(outcomes_of({"color": follower(4)}), "suite", {}, {}, lambda _: arrays_to_bytes(shares))
    return AttentionReadout.table([], said_of(measurement)).columns[2:]


def test_unplayed_episodes_are_left_out_and_a_hidden_tile_counts_where_it_is_visible(
    weighed: AttentionShares,
) -> None:
    mass, at = weighed.mass.copy(), {role: weighed.roles.index(role) for role in ("special", "image.left")}
    mass[..., at["special"]] = np.nan
    mass[0, ..., at["image.left"]] = np.nan
    hidden = replace(weighed, mass=mass)
    share_by_role = {row.role: row.share for row in hidden.rows(())}
    assert "special" not in share_by_role
    assert share_by_role["image.left"] == pytest.approx(float(mass[1:, ..., at["image.left"]].mean()), rel=1e-5)
    values = (hidden.shares()["image.correct"] - hidden.shares()["image.other"])[1:, 1]
    assert hidden.correct_minus_other("suite")[1][0] == pytest.approx(values.mean())
    every = replace(weighed, mass=np.where(np.arange(mass.shape[-1]) == at["special"], np.nan, weighed.mass))
    assert headings(every) == tuple(role for role in headings(weighed) if role != "special")


def test_it_is_marked_as_no_cause_and_enters_no_verdict(copy: Run, attention_records: InterventionResult) -> None:
    assert any("not causal" in note for note in attention_records.notes)
    assert attention_records.verdicts == {}
    assert load_effects(copy, kind="attention").to_csv() == attention_records.to_csv()
    assert set(stored_attention(copy)) == {"color"}


@pytest.mark.slow
def test_the_command_shows_a_table_json_and_csv(copy: Run, attention_records: InterventionResult) -> None:
    def ask(style: str) -> str:
        options = ["--kind", "attention", "--categories", "color", "--items", "2", "--format", style]
        answer = CliRunner().invoke(app, ["intervene", str(copy.path), *options])
        assert answer.exit_code == 0
        assert f"stored as {attention_records.key}" in answer.stderr
        assert "not causal" in " ".join(answer.stderr.split())
        return answer.stdout

    printed = " ".join(ask("table").split())
    assert "What does it attend to?" in printed
    assert "correct − other" in printed
    assert "block 02" in printed
    json_answer = json.loads(ask("json"))
    assert json_answer["certificate"]["attention"]["stream"] == "backbone"
    assert {"category", "role", "block", "iteration", "head", "share"} <= json_answer["effects"][0].keys()
    assert ask("csv").splitlines()[0] == "category,role,block,iteration,head,share,n_episodes"
    assert len(json_answer["effects"]) == BLOCKS * ITERATIONS * HEADS * len(
        {row["role"] for row in json_answer["effects"]}
    )


@pytest.mark.slow
def test_along_the_whole_episode_every_call_is_noted(copy: Run, source: ReplayFiles, twin: "Policy") -> None:
    intervention = AttentionReadout(categories=("shape",), items=1, roles=("language",), readout="per-step")
    effects = run_intervention(copy, intervention, source, load=lambda *_: twin)
    attended = AttentionShares.from_bytes(effects.read(ATTENTION_FILE))
    assert attended.roles == ("all", "language")
    calls = attended.calls
    assert calls.tolist() == 2 * list(range(ceil(STEPS / int(copy.settings["execute"]))))
    assert effects.certificate["attention"]["max_action_change"] == 0.0
    assert effects.to_rich() is not None


@pytest.mark.slow
def test_killed_and_resumed_gives_the_same_bytes_and_damage_is_found(
    copy: Run, attention_records: InterventionResult, source: ReplayFiles, twin: "Policy", tmp_path: Path
) -> None:
    mine = open_run(shutil.copytree(copy.path, tmp_path / "run"))
    folder = mine.path / "interventions" / attention_records.key
    shutil.rmtree(folder)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    intervention = AttentionReadout(categories=("color",), items=2)
    with pytest.raises(KeyboardInterrupt):
        run_intervention(mine, intervention, source, load=lambda *_: twin, progress=stop)
    run_intervention(mine, intervention, source, load=lambda *_: twin)
    file = folder / "attention.npz"
    for name in ("attention.npz", "episodes.npz", "effects.csv", "certificate.json"):
        assert (folder / name).read_bytes() == (
            copy.path / "interventions" / attention_records.key / name
        ).read_bytes()
    file.write_bytes(file.read_bytes()[:-1] + b"?")
    assert any("attention.npz" in problem for problem in verify_run(mine.path, deep=True).problems)


@pytest.mark.slow
def test_attention_refuses_by_name_the_models_that_it_cannot_read(session: ReplaySession) -> None:
    for intervention, family, missing in (
        (AttentionReadout(), "internvla-m1", "attention"),
        (AttentionReadout(roles=("image.left",)), "magma", "tiles"),
    ):
        with pytest.raises(UnsupportedInterventionError, match=f"{family} does not support.*{missing}"):
            list(map(find_family(family).check_intervention, intervention.required_capabilities))
    with pytest.raises(UsageError, match=r"no token of backbone has the role 'smell'; there are image"):
        AttentionReadout(roles=("smell",)).conditions(session)
    with pytest.raises(UsageError, match="give each once"):
        AttentionReadout(roles=("image", "image"))


def test_blocks_with_other_numbers_of_heads_are_no_table() -> None:
    weights = np.ones((1, 2, 3), np.float32) / 3
    mass = AttentionMass({(0, 0): weights, (2, 1): weights})
    shares = shares_by_role(mass, [np.array([True, False, True]), None])
    assert shares.shape == (3, 2, 2, 2)
    assert np.isnan(shares[..., 1]).all()
    shares = shares[..., :1]
    np.testing.assert_allclose(shares[0, 0], 2 / 3)
    assert np.isnan(shares[1]).all()
    assert np.isnan(shares[0, 1]).all()
    for other in (weights[:, :1], np.concatenate([weights, weights])):
        with pytest.raises(CaptureError, match="as many heads"):
            shares_by_role(replace(mass, by_head={**mass.by_head, (1, 0): other}), [np.array([True] * 3)])
