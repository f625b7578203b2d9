"""A patch writes what two plain torch hooks write, bit for bit: one that reads the source, one that writes it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from probe_kit import patching as pt
from probe_kit.errors import CaptureError, EmptyRoleError, UnknownSiteError, UsageError
from probe_kit.hooks import AnswerModel, Observation, Prompt, Reading, Site, load_model
from probe_kit.hooks.families.pi0.adapter import Pi0


@pytest.fixture
def pair(observation: Observation) -> pt.Pair:
    return pt.Pair(observation, replace(observation, image=255 - observation.image), seed=3)


def read(policy: Pi0, module: nn.Module, seen: Observation, seed: int) -> list[torch.Tensor]:
    kept: list[torch.Tensor] = []
    handle = module.register_forward_pre_hook(lambda _, inputs: kept.append(inputs[0].clone()))
    policy.act([seen], [seed])
    handle.remove()
    return kept


def written(
    policy: Pi0, pair: pt.Pair, modules: list[nn.Module], tokens: NDArray[np.bool_], axis: int = 1
) -> NDArray[np.float32]:
    """The clean action with the source's tokens at the inputs of modules, by plain hooks."""
    assert isinstance(pair.clean, Observation)
    assert isinstance(pair.source, Observation)
    where, handles = torch.from_numpy(np.flatnonzero(tokens)), []
    for module in modules:
        source = iter(read(policy, module, pair.source, pair.seed))

        def write(_: object, inputs: tuple[torch.Tensor, ...], own: "object" = source) -> None:
            inputs[0].index_copy_(axis, where, next(own).index_select(axis, where))  # type: ignore[call-overload]

        handles.append((module, write))
    attached = [module.register_forward_pre_hook(write) for module, write in handles]
    found = policy.act([pair.clean], [pair.seed])[0]
    for handle in attached:
        handle.remove()
    return found


@pytest.mark.parametrize("role", ["all", "image", "language", "7", "7-11"])
def test_a_cell_of_the_backbone(pi0_tiny: Pi0, pair: pt.Pair, role: str) -> None:
    (cell,) = pt.find_cells(pi0_tiny, f"backbone.02|{role}")
    assert isinstance(pair.clean, Observation)
    roles, positions = pi0_tiny.roles([pair.clean])["backbone"][0], np.arange(52)
    tokens = {
        "all": roles.valid, "7": positions == 7, "7-11": (positions > 6) & (positions < 12),
    }.get(role, roles.mask(role) if role in ("image", "language") else None)  # fmt: skip
    assert tokens is not None
    expected = written(pi0_tiny, pair, [pi0_tiny.tap(Site("backbone", 2)).module], tokens)
    np.testing.assert_array_equal(pt.patch_cells(pi0_tiny, pair, cell), expected)


def test_a_joint_place_of_keys_and_values_in_two_blocks(pi0_tiny: Pi0, pair: pt.Pair) -> None:
    cells = pt.find_cells(pi0_tiny, "kv.00|image", "kv.02|image")
    assert isinstance(pair.clean, Observation)
    tokens = pi0_tiny.roles([pair.clean])["backbone"][0].mask("image")
    modules = [pi0_tiny.tap(Site("kv", n, own)).module for n in (0, 2) for own in ("keys", "values")]
    expected = written(pi0_tiny, pair, modules, tokens, axis=2)
    np.testing.assert_array_equal(pt.patch_cells(pi0_tiny, pair, cells), expected)
    assert (expected != pt.patch_cells(pi0_tiny, pair, cells[0])).any()


def test_iterations_are_patched_where_they_are_named(pi0_tiny: Pi0, pair: pt.Pair) -> None:
    every, none, some = (pt.find_cells(pi0_tiny, f"expert.01{own}")[0] for own in ("", "@0", "@0-9"))
    by_all = pt.patch_cells(pi0_tiny, pair, every)
    np.testing.assert_array_equal(by_all, pt.patch_cells(pi0_tiny, pair, some))
    assert (by_all != pt.patch_cells(pi0_tiny, pair, none)).any()
    tokens = np.ones(17, bool)
    expected = written(pi0_tiny, pair, [pi0_tiny.tap(Site("expert", 1, iteration=0)).module], tokens)
    np.testing.assert_array_equal(by_all, expected)


def test_everything_at_the_first_layer_is_the_source(pi0_tiny: Pi0, pair: pt.Pair) -> None:
    (cell,) = pt.find_cells(pi0_tiny, "backbone.00")
    source = pi0_tiny.act([pair.source], [pair.seed])[0]  # type: ignore[list-item]
    np.testing.assert_array_equal(pt.patch_cells(pi0_tiny, pair, cell), source)


def test_a_subspace_and_the_rest_of_it_are_parts_of_the_whole(pi0_tiny: Pi0, pair: pt.Pair) -> None:
    (cell,) = pt.find_cells(pi0_tiny, "backbone.02|image")
    whole, clean = pt.patch_cells(pi0_tiny, pair, cell), pi0_tiny.act([pair.clean], [pair.seed])[0]  # type: ignore[list-item]
    every = np.eye(96)
    np.testing.assert_allclose(pt.patch_cells(pi0_tiny, pair, cell, along=every), whole, atol=1e-5)
    np.testing.assert_allclose(
        pt.patch_cells(pi0_tiny, pair, cell, along=every, complement=True), clean, atol=1e-5
    )
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(96, 40)))[0].T
    within, image = torch.from_numpy(basis.T @ basis).float(), slice(0, 36)
    _, source = pt.run_with_cache(pi0_tiny, pair.source, pair.seed, ["backbone.02"])

    def write(own: torch.Tensor, _: pt.HookPoint, rest: bool) -> torch.Tensor:
        difference = source["backbone.02.residual"][:, image] - own[:, image]
        part = difference @ within
        own[:, image] += difference - part if rest else part
        return own

    for rest in (False, True):
        by_hand = pt.run_with_hooks(
            pi0_tiny, pair.clean, {"backbone.02": lambda own, at, rest=rest: write(own, at, rest)}, 3
        )
        patched = pt.patch_cells(pi0_tiny, pair, cell, along=basis, complement=rest)
        np.testing.assert_allclose(patched, by_hand, atol=1e-5)
        assert np.abs(np.asarray(patched) - whole).max() > 1e-4


def test_the_last_position_of_a_model_that_answers_brings_the_sources_logits(observation: Observation) -> None:
    vlm = load_model("vlm-tiny")
    assert isinstance(vlm, AnswerModel)
    clean, source = (
        Prompt(replace(observation, image=image), "Put cube on red shape\n\nA left\nB right", ("A", "B"))
        for image in (observation.image, 255 - observation.image)
    )
    pair = pt.Pair(clean, source)
    (last,) = pt.find_cells(vlm, "answer.03")
    patched, expected = pt.patch_cells(vlm, pair, last), vlm.read([source])
    assert isinstance(patched, Reading)
    np.testing.assert_array_equal(patched.option_logits, expected.option_logits)


def test_cells_are_named_in_order_and_once(pi0_tiny: Pi0) -> None:
    cells = pt.find_cells(
        pi0_tiny, "backbone.*|all,image", "backbone.02|image", "backbone.01.heads.*", "kv.00|language"
    )
    assert len(cells) == len(set(cells)) == 8 + 8 + 1
    assert [str(own) for own in cells[:2]] == ["backbone.00 all", "backbone.00 image"]
    assert str(cells[8]) == "backbone.01.heads.0 all"
    assert pt.all_but(cells, cells[:16]) == (cells[16],)


@pytest.mark.parametrize(
    ("pattern", "error", "said"),
    [
        ("backbone.02|state", UsageError, "no token of backbone has the role 'state'; expected one of all, image"),
        ("backbone.02|image.top", UsageError, "no token of backbone has the role 'image.top'"),
        ("backbone.99|image", UnknownSiteError, r"backbone\.99 is no place"),
        ("", UnknownSiteError, "names no place"),
    ],
)
def test_a_cell_that_is_not_there_is_refused(
    pi0_tiny: Pi0, pattern: str, error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        pt.find_cells(pi0_tiny, pattern)


def test_what_cannot_be_patched_is_refused(pi0_tiny: Pi0, pair: pt.Pair) -> None:
    (cell,) = pt.find_cells(pi0_tiny, "backbone.02|image")
    (beyond,) = pt.find_cells(pi0_tiny, "backbone.02|50-60")
    with pytest.raises(EmptyRoleError, match="backbone has no positions 50-60; it has 0 to 51"):
        pt.patch_cells(pi0_tiny, pair, beyond)
    with pytest.raises(UsageError, match="rows that are not orthonormal"):
        pt.patch_cells(pi0_tiny, pair, cell, along=np.ones((2, 96)))
    with pytest.raises(UsageError, match="give its orthonormal basis as along"):
        pt.patch_cells(pi0_tiny, pair, cell, complement=True)
    with pytest.raises(UsageError, match="no cell is given"):
        pt.patch_cells(pi0_tiny, pair, ())
    with pytest.raises(UsageError, match="no pattern was given"):
        pt.find_cells(pi0_tiny)


def test_a_source_with_another_number_of_tokens_is_refused(observation: Observation) -> None:
    vlm = load_model("vlm-tiny")
    pair = pt.Pair(
        Prompt(observation, "Put cube on red shape", ("A", "B")), Prompt(observation, "red shape", ("A", "B"))
    )
    with pytest.raises(CaptureError, match=r"the source's backbone\.01\.residual has \d+ tokens; expected \d+"):
        pt.patch_cells(vlm, pair, pt.find_cells(vlm, "backbone.01|image"))
