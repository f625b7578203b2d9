"""What is weighed: what the figure shows is what is stored."""

from collections.abc import Callable

import matplotlib as mpl
import numpy as np
import pytest

from probe_kit.errors import NoInterventionsError
from probe_kit.intervene import AttentionShares
from probe_kit.intervene.outcomes import ATTENTION_FILE
from probe_kit.intervene.settings import FORMAT
from probe_kit.retention import retention_table
from probe_kit.retention.displays import AttentionDisplay, attention_curve, collect_figures
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
    store_outcomes(run.location, run.suite, settings, answers, further={ATTENTION_FILE: weighed.to_bytes()})
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


def test_without_attention_there_is_no_such_figure(run: ArrayRun) -> None:
    for draw in (lambda: attention_curve(run), lambda: AttentionDisplay.from_run(run, "color")):
        with pytest.raises(NoInterventionsError, match="--kind attention"):
            draw()
    assert not any(one.name.endswith("attention") for one in collect_figures([run], retention_table([run])))
