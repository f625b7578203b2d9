"""What is weighed: what the figure shows is what is stored."""

from collections.abc import Callable

import matplotlib as mpl
import numpy as np
import pytest

from probe_kit.errors import NoInterventionsError
from probe_kit.intervene import AttentionShares
from probe_kit.intervene.kinds.attention import PatchAttention
from probe_kit.intervene.outcomes import ATTENTION_FILE, FORMAT, PATCHES_FILE, arrays_to_bytes
from probe_kit.retention import retention_table
from probe_kit.retention.displays import AttentionDisplay, attention_curve, attention_on_picture, collect_figures
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.train import ArrayRun
from tests.intervene.answers import follower, outcomes_of, store_outcomes

mpl.use("agg")
ROLES = ("all", "image", "image.left", "image.right", "language")


@pytest.fixture
def run(probed_run: Callable[..., ArrayRun]) -> ArrayRun:
    return probed_run({"color": ([0.5, 0.9], [[0.7]])})


def noted(run: ArrayRun) -> AttentionShares:
    """Four inferences, three blocks of which one is not read, two iterations, two heads."""
    draw = np.random.default_rng(0)
    mass = draw.uniform(0, 0.2, (4, 3, 2, 2, len(ROLES))).astype(np.float32)
    mass[..., 0] = mass[..., 1] + mass[..., 4]
    mass[:, 1] = np.nan
    names = np.array(["a", "b", "c", "d"])
    sides = np.array(["left", "right"] * 2)
    weighed = AttentionShares(ROLES, names, names, np.array(["color"] * 4), sides, np.zeros(4, int), mass)
    answers = outcomes_of({"color": follower(4)})
    settings = {
        "format": FORMAT, "kind": "attention", "run_settings": run.settings_sha256, "stamp": "", "wording": None,
        "categories": ["color"],
    }  # fmt: skip
    boxes = np.array([[0, 0, 0.5, 1], [0.5, 0, 1, 1]], np.float32)
    weights = np.full((4, 3, 2), np.nan, np.float16)
    weights[:, [0, 2]] = [[0.3, 0.1], [0.1, 0.2]]
    episodes = run.episodes["episode_id"].to_numpy(str)[:4]
    patches = PatchAttention(episodes, np.zeros(4, int), weights, np.array(["top"] * 2), boxes)
    further = {ATTENTION_FILE: arrays_to_bytes(weighed), PATCHES_FILE: arrays_to_bytes(patches)}
    store_outcomes(run.location, run.suite, settings, answers, further=further)
    return weighed


def test_it_shows_means_by_block_and_how_heads_and_iterations_differ(run: ArrayRun) -> None:
    weighed = noted(run)
    display = AttentionDisplay.from_run(run, "color").plot()
    assert display.blocks.tolist() == [0, 2]
    assert display.roles == ("image", "language", "image.correct", "image.other", "action")
    assert (display.iterations.shape, display.heads.shape) == ((5, 2, 2), (5, 2, 2))
    shares = weighed.shares()
    for row, role in enumerate(display.roles):
        np.testing.assert_allclose(display.mean[row], 100 * shares[role][:, [0, 2]].mean(axis=(0, 2, 3)))
        np.testing.assert_allclose(display.iterations[row], 100 * shares[role][:, [0, 2]].mean(axis=(0, 3)))
        np.testing.assert_allclose(display.heads[row], 100 * shares[role][:, [0, 2]].mean(axis=(0, 2)))
    assert display.ax_ is not None
    labels = {line.get_label() for line in display.ax_.get_lines()}
    assert {"correct picture's tile", "other picture's tile", "its own tokens", "language"} <= labels
    assert len(attention_curve(run).axes) == 1
    (shown,) = (one for one in collect_figures([run], retention_table([run])) if one.name.endswith("attention"))
    assert "no verdict" in shown.reading


def test_the_attention_of_each_block_is_drawn_over_the_stored_picture(run: ArrayRun) -> None:
    noted(run)
    with pytest.raises(NoInterventionsError, match="no picture to draw it on"):
        attention_on_picture(run)
    pixels = np.zeros((24, 32, 3), np.uint8)
    run.location.write(thumbnail_key(0), as_thumbnail((pixels, pixels)))
    axes = [own for own in attention_on_picture(run, "color").axes if own.get_visible()]
    assert [own.get_title(loc="left") for own in axes] == ["all blocks: 35 %", "block 0: 40 %", "block 2: 30 %"]
    overlays = [own.collections[0].get_facecolor()[:, 3] for own in axes]
    np.testing.assert_allclose(overlays, [[0.8, 0.6], [0.8, 0.8 / 3], [0.4, 0.8]], rtol=1e-2)
    left, right = axes[0].collections[0].get_paths()
    assert left.get_extents().bounds == pytest.approx((-0.5, -0.5, 16, 24))
    assert right.get_extents().bounds == pytest.approx((15.5, -0.5, 16, 24))
    names = [one.name for one in collect_figures([run], retention_table([run])) if "attention" in one.name]
    assert [name.partition("-attention")[2] for name in names] == ["-picture", ""]


def test_without_attention_there_is_no_such_figure(run: ArrayRun) -> None:
    for draw in (lambda: attention_curve(run), lambda: AttentionDisplay.from_run(run, "color")):
        with pytest.raises(NoInterventionsError, match="--kind attention"):
            draw()
    assert not any(one.name.endswith("attention") for one in collect_figures([run], retention_table([run])))
