"""Figures of stored interventions: their numbers, what is drawn, and what there is without one."""

from collections.abc import Callable
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest

from probe_kit.errors import NoInterventionsError, UnknownCategoryError, UnknownSiteError
from probe_kit.intervene import AttentionShares, UseVerdict
from probe_kit.intervene.kinds.attention import ATTENTION_FILE, PATCHES_FILE, PatchAttention
from probe_kit.intervene.outcomes import ConditionOutcomes, arrays_to_bytes
from probe_kit.intervene.settings import FORMAT
from probe_kit.retention import RetentionRow, retention_table
from probe_kit.retention.displays import (
    AttentionDisplay,
    DoseResponseDisplay,
    KnockoutDisplay,
    SiteEffectDisplay,
    attention_curve,
    attention_on_picture,
    collect_figures,
    dose_response,
    knockout_curve,
    site_effect_curve,
)
from probe_kit.retention.displays.display import OPEN, Display
from probe_kit.retention.displays.interventions import _share
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.train import ArrayRun, load_results
from tests.intervene.answers import follower, habit, knockout_of, outcomes_of, store_outcomes

mpl.use("agg")
SIGNAL = ([0.5, 0.9], [[0.7]])


def store(run: ArrayRun, kind: str, answers: ConditionOutcomes, **options: str) -> None:
    categories = list(dict.fromkeys(answers.categories.tolist()))
    settings = {
        "format": FORMAT, "kind": kind, "run_settings": run.settings_sha256, "stamp": "", "wording": None,
        "categories": categories, **options,
    }  # fmt: skip
    store_outcomes(run.location, run.suite, settings, answers)


def inside(answers: ConditionOutcomes, condition: str = "|all", **shares: float) -> ConditionOutcomes:
    """shares: by place (`__` for `.`), how many of the episodes go where the exchange brings them."""
    count = answers.episodes.size
    rows = [
        np.where(np.arange(count) < share * count, answers.of("image_swap"), answers.of("clean"))
        for share in shares.values()
    ]
    lateral = np.vstack([answers.displacement, *rows])
    names = tuple(f"{name.replace('__', '.')}{condition}" for name in shares)
    return replace(
        answers,
        conditions=(*answers.conditions, *names),
        displacement=lateral,
        max_action_change=np.abs(lateral - lateral[0]),
        edit_log=np.zeros((*lateral.shape, 5)),
    )


def used(row: RetentionRow) -> UseVerdict:
    assert row.image_swap.use is not None
    return row.image_swap.use


@pytest.fixture
def run(probed_run: Callable[..., ArrayRun]) -> ArrayRun:
    """Color follows, shape does not; both can be read at layer 1."""
    probed = probed_run({"color": SIGNAL, "shape": SIGNAL})
    answers = outcomes_of({"color": follower(48), "shape": habit(48)})
    store(probed, "image-swap", answers)
    return probed


def legend_of(display: Display) -> list[str]:
    """The entries of the legend of a display that was plotted alone."""
    assert display.ax_ is not None
    (legend,) = display.ax_.get_figure(root=True).legends
    return [text.get_text() for text in legend.get_texts()]


def test_it_shows_accuracies_and_turned_episodes_by_layer(run: ArrayRun) -> None:
    answers = outcomes_of({"color": follower(48)})
    store(run, "interchange", inside(answers, backbone__00=1.0, backbone__01=0.0))
    display = SiteEffectDisplay.from_run(run, load_results(run), "color").plot()
    np.testing.assert_allclose(display.readable.percent, [50.0, 90.0])
    assert display.readable.significant.tolist() == [False, True]
    np.testing.assert_allclose(display.passes["all"].percent, [100.0, 0.0])
    assert display.passes["all"].significant.tolist() == [True, False]
    assert display.read is None
    assert display.ax_ is not None
    labels = [line.get_label() for line in display.ax_.get_lines()]
    assert "passes: all" in labels
    assert legend_of(display)[-2:] == ["filled: p < 0.05, family-wise", OPEN]
    names = [exhibit.name for exhibit in collect_figures([run], retention_table([run]))]
    assert any("causes" in name for name in names)


def test_a_view_or_a_category_without_probes_is_refused_by_name(run: ArrayRun) -> None:
    answers = {name: follower(48) for name in ("color", "state")}
    store(run, "interchange", inside(outcomes_of(answers), backbone__00=1.0, backbone__01=0.0))
    with pytest.raises(UnknownSiteError, match="'tokens' was not probed; probed: mean"):
        site_effect_curve(run, load_results(run), "tokens")
    with pytest.raises(UnknownCategoryError, match="'state' was not probed; probed: color, shape"):
        SiteEffectDisplay.from_run(run, load_results(run), "state")


def test_without_an_interchange_there_is_no_such_figure(run: ArrayRun) -> None:
    with pytest.raises(NoInterventionsError, match="--kind interchange"):
        SiteEffectDisplay.from_run(run, load_results(run), "color")
    with pytest.raises(NoInterventionsError):
        site_effect_curve(run, load_results(run))
    assert not any("causes" in exhibit.name for exhibit in collect_figures([run], retention_table([run])))


def test_tables_say_what_is_used_and_why(run: ArrayRun) -> None:
    rows = {row.category: row for row in retention_table([run]).rows}
    assert {name: used(rows[name]).behaviour for name in ("color", "shape")} == {
        "color": "used", "shape": "not used",
    }  # fmt: skip
    assert used(rows["shape"]).reason.endswith("positive control: color")
    assert (rows["color"].image_swap.follow_rate, rows["color"].image_swap.reversal_rate) == (1.0, 0.0)


def test_where_nothing_carries_it_inside_the_place_is_open_and_the_behaviour_is_not(run: ArrayRun) -> None:
    answers = outcomes_of({"color": follower(48)})
    store(run, "interchange", inside(answers, backbone__00=0.0, backbone__01=0.1))
    rows = {row.category: row for row in retention_table([run]).rows}
    assert used(rows["color"]).behaviour == "used"
    assert used(rows["color"]).where == "no place that was tried carries half of it"
    assert used(rows["shape"]).behaviour == "not used"


@pytest.mark.slow
@pytest.mark.parametrize("is_memory_last", [False, True])
def test_a_memory_and_a_map_are_read_beside_each_other(run: ArrayRun, is_memory_last: bool) -> None:
    """Whichever was stored last took the other's place in verdict and figure."""
    answers = outcomes_of({"color": follower(48)})
    both = {
        "backbone.*": inside(answers, backbone__00=1.0, backbone__01=1.0),
        "kv.*": inside(answers, kv__00=1.0, kv__01=0.0),
    }
    for sites in sorted(both, reverse=not is_memory_last):
        store(run, "interchange", both[sites], sites=sites)
    (row,) = (row for row in retention_table([run]).rows if row.category == "color")
    assert (used(row).behaviour, used(row).where) == ("used", "passes at backbone.01; read at kv.00")
    display = SiteEffectDisplay.from_run(run, load_results(run), "color")
    assert display.read is not None
    assert (display.passes["all"].percent.tolist(), display.read.percent.tolist()) == ([100, 100], [100, 0])


@pytest.mark.slow
def test_the_tie_is_of_the_layers_at_which_a_probe_is_significant(run: ArrayRun) -> None:
    """Layer 1 is read by probes: unread if nothing passes there, read if the probe's direction carries it."""

    def tie() -> str:
        (row,) = (row for row in retention_table([run]).rows if row.category == "color")
        return used(row).tie

    assert tie() == "whether the readable copy is the one used was not tested"
    answers = outcomes_of({"color": follower(48)})
    store(run, "interchange", inside(answers, backbone__00=1.0, backbone__01=0.0), direction="none")
    assert tie() == "the readable copy is not the one used: the answer passes elsewhere"
    both = inside(inside(answers, "|all|probe", backbone__01=1.0), "|all|control-1", backbone__01=0.0)
    store(run, "interchange", both, direction="probe", seed="0")
    assert tie() == "the readable copy is read (backbone.01 all)"


def test_a_direction_alone_is_no_search_and_no_map(run: ArrayRun) -> None:
    """It turned *used* into *undecided*, and stopped the report for want of a map to draw."""
    answers = outcomes_of({"color": follower(48)})
    along = inside(answers, "|image|mean-difference", backbone__01=0.0)
    store(run, "interchange", along, direction="mean-difference")
    (row,) = (row for row in retention_table([run]).rows if row.category == "color")
    assert (used(row).behaviour, used(row).where) == ("used", "")
    assert not any("causes" in exhibit.name for exhibit in collect_figures([run], retention_table([run])))
    with pytest.raises(NoInterventionsError, match="--kind interchange"):
        site_effect_curve(run, load_results(run))


mpl.use("agg")
ROLES = ("all", "image", "image.left", "image.right", "language")


@pytest.fixture
def drawn_run(probed_run: Callable[..., ArrayRun]) -> ArrayRun:
    return probed_run({"color": ([0.5, 0.9], [[0.7]])})


def noted(drawn_run: ArrayRun) -> AttentionShares:
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
        "format": FORMAT, "kind": "attention", "run_settings": drawn_run.settings_sha256, "stamp": "",
        "wording": None,
        "categories": ["color"],
    }  # fmt: skip
    boxes = np.array([[0, 0, 0.5, 1], [0.5, 0, 1, 1]], np.float32)
    weights = np.full((4, 3, 2), np.nan, np.float16)
    weights[:, [0, 2]] = [[0.3, 0.1], [0.1, 0.2]]
    episodes = drawn_run.episodes["episode_id"].to_numpy(str)[:4]
    patches = PatchAttention(episodes, np.zeros(4, int), weights, np.array(["top"] * 2), boxes)
    extra_files = {ATTENTION_FILE: arrays_to_bytes(weighed), PATCHES_FILE: arrays_to_bytes(patches)}
    store_outcomes(drawn_run.location, drawn_run.suite, settings, answers, extra_files=extra_files)
    return weighed


def test_it_shows_means_by_block_and_how_heads_and_iterations_differ(drawn_run: ArrayRun) -> None:
    weighed = noted(drawn_run)
    display = AttentionDisplay.from_run(drawn_run, "color").plot()
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
    assert legend_of(display)[-2:] == ["wide bar: least to largest iteration", "dot: one head"]
    assert len(attention_curve(drawn_run).axes) == 1
    (attention_exhibit,) = (
        exhibit
        for exhibit in collect_figures([drawn_run], retention_table([drawn_run]))
        if exhibit.name.endswith("attention")
    )
    assert "no verdict" in attention_exhibit.reading


def test_the_attention_of_each_block_is_drawn_over_the_stored_picture(drawn_run: ArrayRun) -> None:
    noted(drawn_run)
    with pytest.raises(NoInterventionsError, match="no picture to draw it on"):
        attention_on_picture(drawn_run)
    pixels = np.zeros((24, 32, 3), np.uint8)
    drawn_run.location.write(thumbnail_key(0), as_thumbnail((pixels, pixels)))
    axes = [panel for panel in attention_on_picture(drawn_run, "color").axes if panel.get_visible()]
    assert [panel.get_title(loc="left") for panel in axes] == [
        "all blocks: 35 %",
        "block 0: 40 %",
        "block 2: 30 %",
    ]
    overlays = [panel.collections[0].get_facecolor()[:, 3] for panel in axes]
    np.testing.assert_allclose(overlays, [[0.8, 0.6], [0.8, 0.8 / 3], [0.4, 0.8]], rtol=1e-2)
    left, right = axes[0].collections[0].get_paths()
    assert left.get_extents().bounds == pytest.approx((-0.5, -0.5, 16, 24))
    assert right.get_extents().bounds == pytest.approx((15.5, -0.5, 16, 24))
    names = [
        exhibit.name
        for exhibit in collect_figures([drawn_run], retention_table([drawn_run]))
        if "attention" in exhibit.name
    ]
    assert [name.partition("-attention")[2] for name in names] == ["-picture", ""]


def test_without_attention_there_is_no_such_figure(drawn_run: ArrayRun) -> None:
    for draw in (
        lambda: attention_curve(drawn_run),
        lambda: AttentionDisplay.from_run(drawn_run, "color"),
    ):
        with pytest.raises(NoInterventionsError, match="--kind attention"):
            draw()
    assert not any(
        exhibit.name.endswith("attention")
        for exhibit in collect_figures([drawn_run], retention_table([drawn_run]))
    )


mpl.use("agg")
EPISODES = 48


@pytest.fixture
def steered_run(probed_run: Callable[..., ArrayRun]) -> ArrayRun:
    return probed_run({"color": SIGNAL})


def steered(steered_run: ArrayRun) -> None:
    """Toward the wrong side: half of the pushed turn at dose 2, all at dose 4; the control turns one in eight."""
    answers = outcomes_of({"color": follower(EPISODES)})
    plain, item = answers.of("clean"), np.arange(EPISODES)
    turned = {
        "mean-difference|0": item < 0, "mean-difference|2": item < EPISODES / 2, "mean-difference|4": item >= 0,
        "control-1|2": item < 0, "control-1|4": item % 8 == 0,
    }  # fmt: skip
    lateral = np.vstack([plain, *(np.where(which, -plain, plain) for which in turned.values())])
    answers = replace(
        answers,
        conditions=("clean", *(f"backbone.01|image|{name}" for name in turned)),
        displacement=lateral,
        max_action_change=np.abs(lateral - lateral[0]),
        edit_log=np.ones((*lateral.shape, 5)),
    )
    settings = {
        "format": FORMAT, "kind": "steer", "run_settings": steered_run.settings_sha256, "stamp": "",
        "wording": None, "categories": ["color"], "target_side": "wrong",
    }  # fmt: skip
    store_outcomes(steered_run.location, steered_run.suite, settings, answers)


def test_it_shows_episodes_that_turn_by_dose_and_side_beside_controls(steered_run: ArrayRun) -> None:
    steered(steered_run)
    display = DoseResponseDisplay.from_run(steered_run, "color").plot()
    assert display.position == "backbone.01 image"
    np.testing.assert_allclose(display.coefficients, [0, 2, 4])
    np.testing.assert_allclose(display.net, [0, 50, 100])
    np.testing.assert_allclose((display.net_left + display.net_right) / 2, display.net)
    np.testing.assert_allclose(display.controls, [[np.nan, 0, 12.5]])
    np.testing.assert_allclose(display.relative_change, 1)
    assert display.significant.tolist() == [False, True, True]
    assert display.ax_ is not None
    labels = [line.get_label() for line in display.ax_.get_lines()]
    assert {"all episodes", "pushed to the left", "pushed to the right"} <= set(labels)
    assert legend_of(display)[-2:] == ["filled: more than random directions", OPEN]
    assert len(display.ax_.collections) == 1
    assert [tick.get_text() for tick in display.ax_.get_xticklabels()] == ["0\n100 %", "2\n100 %", "4\n100 %"]
    names = [exhibit.name for exhibit in collect_figures([steered_run], retention_table([steered_run]))]
    assert any(name.endswith("doses") for name in names)
    assert len(dose_response(steered_run).axes) == 1


def test_without_a_steering_there_is_no_such_figure(steered_run: ArrayRun) -> None:
    for draw in (
        lambda: dose_response(steered_run),
        lambda: DoseResponseDisplay.from_run(steered_run, "color"),
    ):
        with pytest.raises(NoInterventionsError, match="--kind steer"):
            draw()
    assert not any(
        exhibit.name.endswith("doses")
        for exhibit in collect_figures([steered_run], retention_table([steered_run]))
    )
    steered(steered_run)
    with pytest.raises(NoInterventionsError, match=r"it has it at backbone\.01 image"):
        DoseResponseDisplay.from_run(steered_run, "color", "backbone.02 image")


@pytest.mark.parametrize(
    ("ratio", "text"), [(0, "0 %"), (0.00006, "<0.1 %"), (0.0071, "0.71 %"), (0.24, "24 %"), (2.5, "250 %")]
)
def test_small_changes_of_the_tokens_are_not_written_as_none(ratio: float, text: str) -> None:
    assert _share(ratio) == text


# -- knockouts ---------------------------------------------------------------------------------------------------


def test_a_knockout_shows_a_curve_a_role_over_its_controls(run: ArrayRun) -> None:
    reads = {"image": [{2}], "language": []}
    answers = knockout_of(reads, 0)
    store(run, "knockout", answers)
    display = KnockoutDisplay.from_run(run, "color")
    curves = {(curve.role, curve.growth): curve for curve in display.curves}
    assert curves.keys() == {(role, growth) for role in reads for growth in ("up to", "from")}
    np.testing.assert_array_equal(curves["image", "up to"].layers, range(6))
    np.testing.assert_array_equal(curves["image", "up to"].is_read, [False, False, True, True, True, True])
    np.testing.assert_allclose(curves["image", "from"].lost, [90, 90, 90, 0, 0, 0], atol=10)
    np.testing.assert_allclose(curves["language", "up to"].controls, 0, atol=5)
    assert not curves["language", "from"].is_read.any()
    labels = knockout_curve(run).legends[0].get_texts()
    assert [text.get_text() for text in labels][-2:] == ["filled: more than random tokens", OPEN]
    assert "image, up to the layer" in {label.get_text() for label in labels}
    names = [figure.name for figure in collect_figures([run], retention_table([run]))]
    assert any(name.endswith("knockout") for name in names)


def test_places_of_kv_are_one_curve_by_the_block_that_is_read(run: ArrayRun) -> None:
    answers = knockout_of({"image": [{2}]}, 0, "1")
    roles = tuple(
        f"kv.{cell.site[7:9]}" if cell.role == "image" and not cell.is_control else cell.role
        for cell in answers.cells
    )
    store(run, "knockout", replace(answers, roles=roles))
    (curve,) = KnockoutDisplay.from_run(run, "color").curves
    assert (curve.role, curve.growth) == ("kv", "around")
    np.testing.assert_array_equal(curve.is_read, [False, False, True, False, False, False])


def test_without_a_knockout_there_is_no_such_figure(run: ArrayRun) -> None:
    with pytest.raises(NoInterventionsError, match="--kind knockout"):
        knockout_curve(run)
