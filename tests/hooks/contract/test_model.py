"""What taps select and models refuse, on networks of a few lines."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from probe_kit.errors import CaptureError, ObservationError, UnknownSiteError, UsageError
from probe_kit.hooks import Model, ModelCard, Observation, Reading, Roles, Rows, Site, Stream, Tap, capture, edit
from probe_kit.hooks.testing import example_observations

CARD = ModelCard("guided", "none", "0" * 64, True, 1, "float32", "cpu", "none", ("primary",), 0, 0)


class Guided(Model):
    """Runs conditional rows over unconditional ones, and each step's layer once more beforehand."""

    def __init__(self) -> None:
        self.card = CARD
        self.layer, self.norm = nn.Identity(), nn.Identity()
        self.streams = {"expert": Stream("expert", 1, 3, iterations=2, quantities=("residual",))}
        self.role_names = {"expert": ("action",)}
        self.select: dict = {}

    def roles(self, seen: Sequence[Observation]) -> dict[str, list[Roles]]:
        return {"expert": [Roles.from_labels(["action"] * 4)] * len(seen)}

    def tap(self, site: Site) -> Tap:
        self.stream_of(site)
        return Tap(self.layer, 2, **self.select)

    def step(self, rows: Tensor) -> Tensor:
        doubled: Tensor = self.layer(torch.cat([rows, -rows]))
        return doubled


ROWS = torch.arange(24, dtype=torch.float32).reshape(2, 4, 3)
SITES = [Site("expert", 0, iteration=step) for step in (0, 1)]


def test_one_half_of_a_doubled_batch_is_the_stream() -> None:
    model = Guided()
    for index, sign in ((0, 1), (1, -1)):
        model.select = {"rows": Rows(index, 2)}
        with capture(model, SITES) as tape:
            model.step(ROWS)
            model.step(2 * ROWS)
        torch.testing.assert_close(tape[SITES[0]], sign * ROWS)
        torch.testing.assert_close(tape[SITES[1]], sign * 2 * ROWS)


def test_an_edit_of_one_half_leaves_the_other() -> None:
    model = Guided()
    model.select = {"rows": Rows(0, 2)}
    with edit(model, {SITES[0]: torch.zeros_like, SITES[1]: torch.zeros_like}):
        first, second = model.step(ROWS), model.step(ROWS)
    for output in (first, second):
        torch.testing.assert_close(output, torch.cat([0 * ROWS, -ROWS]))


def test_rows_that_do_not_divide_are_refused() -> None:
    model = Guided()
    model.select = {"rows": Rows(0, 3)}
    with pytest.raises(CaptureError, match="3 equal blocks"), capture(model, SITES):
        model.step(ROWS)


def test_calls_before_the_first_one_are_passed_over_but_counted() -> None:
    model = Guided()
    model.select = {"first": 1}
    with capture(model, SITES) as tape:
        for factor in (1, 2, 3):
            model.step(factor * ROWS)
    torch.testing.assert_close(tape[SITES[0]][:2], 2 * ROWS)
    with pytest.raises(CaptureError, match="fired 1 times in one inference; expected 3"), capture(model, SITES):
        model.step(ROWS)


def test_a_view_brings_flat_tokens_to_rows_and_carries_edits_back() -> None:
    model = Guided()
    model.select = {"view": lambda flat: flat.reshape(2, 4, 3)}
    flat = ROWS.reshape(8, 3).clone()
    with edit(model, dict.fromkeys(SITES, lambda activation: activation + 1)):
        changed = model.layer(flat)
        model.layer(flat.clone())
    torch.testing.assert_close(changed, ROWS.reshape(8, 3) + 1)


def test_a_tensor_given_by_keyword_is_captured_and_another_keyword_is_an_error() -> None:
    class Called(nn.Module):
        def forward(self, *, hidden: Tensor) -> Tensor:
            return hidden

    model = Guided()
    model.layer = Called()  # type: ignore[assignment]
    model.select = {"argument": "hidden"}
    with capture(model, SITES) as tape:
        model.layer(hidden=ROWS)
        model.layer(hidden=2 * ROWS)
    torch.testing.assert_close(tape[SITES[1]], 2 * ROWS)
    model.select = {"argument": "states"}
    with pytest.raises(CaptureError, match="without the keyword 'states'"), capture(model, SITES):
        model.layer(hidden=ROWS)


def test_a_quantity_that_was_not_declared_is_refused_by_name() -> None:
    with pytest.raises(UnknownSiteError, match="expert: 1 layers x 2 iterations of residual"):
        Guided().tap(Site("expert", 0, "mlp", 0))


def test_what_the_card_rules_out_is_refused() -> None:
    model, seen = Guided(), example_observations(["one", "two"])
    model.check(seen, [0, 1])
    with pytest.raises(ObservationError, match="2 observations but 1 seeds"):
        model.check(seen, [0])
    model.card = replace(CARD, batch=1)
    with pytest.raises(ObservationError, match="at most 1"):
        model.check(seen)
    model.card = replace(CARD, needs=frozenset({"intrinsics", "camera.wrist"}))
    with pytest.raises(ObservationError, match=r"no camera\.wrist, which guided reads"):
        model.check(seen[:1])


def test_a_stream_of_an_unknown_part_is_refused_and_old_names_tell_theirs() -> None:
    assert Stream("expert", 2, 8).part == "action"
    with pytest.raises(UsageError, match="declares part None"):
        Stream("torso", 2, 8)


def test_a_reading_picks_the_options_and_says_their_share() -> None:
    logits = np.log(np.array([[0.1, 0.2, 0.7], [0.5, 0.25, 0.25]], np.float32))
    reading = Reading.of(logits, [[0, 2], [1, 2]])
    np.testing.assert_allclose(np.exp(reading.option_logits), [[0.1, 0.7], [0.25, 0.25]], rtol=1e-6)
    np.testing.assert_allclose(reading.option_mass, [0.8, 0.5], rtol=1e-6)
