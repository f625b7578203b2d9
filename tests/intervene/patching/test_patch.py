"""One inference of a policy with its activations, patterns and patches."""

import subprocess
import sys
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
from probe_kit.intervene.patching.patch import infer


@pytest.fixture(scope="module")
def vlm() -> AnswerModel:
    model = load_model("vlm-tiny")
    assert isinstance(model, AnswerModel)
    return model


@pytest.fixture
def question(observation: Observation) -> Prompt:
    return Prompt(observation, "Put cube on red shape\n\nA left\nB right", ("A", "B"))


def test_the_cache_holds_what_plain_hooks_read_and_the_output_is_the_plain_one(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    output, cache = pt.run_with_cache(pi0_tiny, observation, 7)
    np.testing.assert_array_equal(output, pi0_tiny.act([observation], [7])[0])
    assert set(cache) == set(pi0_tiny.sites())
    recorded: list[torch.Tensor] = []
    module = pi0_tiny.tap(Site("expert", 1, iteration=0)).module
    handle = module.register_forward_pre_hook(lambda _, inputs: recorded.append(inputs[0].clone()))
    pi0_tiny.act([observation], [7])
    handle.remove()
    for step, tensor in enumerate(recorded):
        assert torch.equal(cache[f"expert.01.residual@{step}"], tensor)


def test_places_of_any_quantity_are_cached_by_pattern(pi0_tiny: Pi0, observation: Observation) -> None:
    _, cache = pt.run_with_cache(pi0_tiny, observation, 7, ["kv.01", "backbone.*.heads", "expert.02@8-9"])
    assert set(map(str, cache)) == {
        "kv.01.keys", "kv.01.values", *(f"backbone.{n:02d}.heads" for n in range(3)), "expert.02.residual@8",
        "expert.02.residual@9",
    }  # fmt: skip


def test_hooks_change_what_plain_hooks_change_and_know_where_they_are(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    points: list[pt.HookPoint] = []

    def silence(activation: torch.Tensor, point: pt.HookPoint) -> torch.Tensor:
        points.append(point)
        assert point.roles is not None
        activation[:, point.roles.mask("image")] = 0
        return activation

    hooked = pt.run_with_hooks(pi0_tiny, observation, {"backbone.01": silence}, 7)
    image = torch.from_numpy(pi0_tiny.roles([observation])["backbone"][0].mask("image"))

    def plain(_: object, inputs: tuple[torch.Tensor, ...]) -> None:
        inputs[0][:, image] = 0  # in place, as the residual path reads the same tensor

    handle = pi0_tiny.tap(Site("backbone", 1)).module.register_forward_pre_hook(plain)
    expected = pi0_tiny.act([observation], [7])[0]
    handle.remove()
    np.testing.assert_array_equal(hooked, expected)
    assert (expected != pi0_tiny.act([observation], [7])[0]).any()
    assert [str(point.site) for point in points] == ["backbone.01.residual"]


def test_a_hook_is_called_at_every_iteration_it_names(pi0_tiny: Pi0, observation: Observation) -> None:
    iterations: list[int | None] = []

    def note(activation: torch.Tensor, point: pt.HookPoint) -> torch.Tensor:
        iterations.append(point.iteration)
        return activation

    same = pt.run_with_hooks(pi0_tiny, observation, {"expert.02@3-5": note, "vision.00": note}, 7)
    assert iterations == [0, 3, 4, 5], "the first camera, then three steps"
    np.testing.assert_array_equal(same, pi0_tiny.act([observation], [7])[0])


def test_a_model_that_answers_is_given_questions(vlm: AnswerModel, question: Prompt) -> None:
    reading, cache = pt.run_with_cache(vlm, question)
    assert isinstance(reading, Reading)
    np.testing.assert_array_equal(reading.option_logits, vlm.read([question]).option_logits)
    lens = pt.logit_lens(vlm, cache, k=1)
    assert lens.layers == (0, 1, 2, 3)

    def double(activation: torch.Tensor, point: pt.HookPoint) -> torch.Tensor:
        assert point.roles is not None
        assert point.roles.mask("answer").all()
        return 2 * activation

    changed = pt.run_with_hooks(vlm, question, {"answer.01": double})
    assert isinstance(changed, Reading)
    assert (changed.option_logits != reading.option_logits).any()


def test_a_patch_that_does_not_fit_the_model_is_refused(
    pi0_tiny: Pi0, vlm: AnswerModel, observation: Observation, question: Prompt
) -> None:
    with pytest.raises(UsageError, match="pi0-tiny answers no questions: give it an observation"):
        infer(pi0_tiny, question)
    with pytest.raises(UsageError, match="pi0-tiny answers no questions"):
        pt.run_with_hooks(pi0_tiny, question, {})
    with pytest.raises(UsageError, match="vlm-tiny does not act: give it a question"):
        infer(vlm, observation)
    with pytest.raises(UnknownSiteError, match="names no place"):
        pt.run_with_cache(pi0_tiny, observation, places=["backbone"])


def test_hooks_that_cannot_be_are_refused(pi0_tiny: Pi0, observation: Observation) -> None:
    with pytest.raises(
        UsageError, match=r"two patterns name backbone\.01\.residual; give every site one function"
    ):
        pt.run_with_hooks(
            pi0_tiny,
            observation,
            {"backbone.*": lambda activation, _: activation, "backbone.01": lambda activation, _: activation},
        )
    with pytest.raises(CaptureError, match=r"the edit of backbone\.01\.residual returned .*; expected"):
        pt.run_with_hooks(pi0_tiny, observation, {"backbone.01": lambda activation, _: activation[:, :3]})


def test_the_names_are_found_without_torch() -> None:
    code = "import sys; from probe_kit import patching as pt; print(len(pt.__all__), 'torch' in sys.modules)"
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True)
    assert completed.stdout.split() == [str(len(pt.__all__)), "False"]


@pytest.fixture
def pair(observation: Observation) -> pt.Pair:
    return pt.Pair(observation, replace(observation, image=255 - observation.image), seed=3)


def read(policy: Pi0, module: nn.Module, observation: Observation, seed: int) -> list[torch.Tensor]:
    recorded: list[torch.Tensor] = []
    handle = module.register_forward_pre_hook(lambda _, inputs: recorded.append(inputs[0].clone()))
    policy.act([observation], [seed])
    handle.remove()
    return recorded


def written(
    policy: Pi0, pair: pt.Pair, modules: list[nn.Module], tokens: NDArray[np.bool_], axis: int = 1
) -> NDArray[np.float32]:
    """The clean action with the source's tokens at the inputs of modules, by plain hooks."""
    assert isinstance(pair.clean, Observation)
    assert isinstance(pair.source, Observation)
    where, handles = torch.from_numpy(np.flatnonzero(tokens)), []
    for module in modules:
        source = iter(read(policy, module, pair.source, pair.seed))

        def write(_: object, inputs: tuple[torch.Tensor, ...], replacements: "object" = source) -> None:
            inputs[0].index_copy_(axis, where, next(replacements).index_select(axis, where))  # type: ignore[call-overload]

        handles.append((module, write))
    attached = [module.register_forward_pre_hook(write) for module, write in handles]
    patched_action = policy.act([pair.clean], [pair.seed])[0]
    for handle in attached:
        handle.remove()
    return patched_action


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


@pytest.mark.slow
def test_a_joint_place_of_keys_and_values_in_two_blocks(pi0_tiny: Pi0, pair: pt.Pair) -> None:
    cells = pt.find_cells(pi0_tiny, "kv.00|image", "kv.02|image")
    assert isinstance(pair.clean, Observation)
    tokens = pi0_tiny.roles([pair.clean])["backbone"][0].mask("image")
    modules = [pi0_tiny.tap(Site("kv", n, part)).module for n in (0, 2) for part in ("keys", "values")]
    expected = written(pi0_tiny, pair, modules, tokens, axis=2)
    np.testing.assert_array_equal(pt.patch_cells(pi0_tiny, pair, cells), expected)
    assert (expected != pt.patch_cells(pi0_tiny, pair, cells[0])).any()


@pytest.mark.slow
def test_iterations_are_patched_where_they_are_named(pi0_tiny: Pi0, pair: pt.Pair) -> None:
    every, none, some = (pt.find_cells(pi0_tiny, f"expert.01{suffix}")[0] for suffix in ("", "@0", "@0-9"))
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


@pytest.mark.slow
def test_a_subspace_and_the_rest_of_it_are_parts_of_the_whole(pi0_tiny: Pi0, pair: pt.Pair) -> None:
    (cell,) = pt.find_cells(pi0_tiny, "backbone.02|image")
    full_patch, clean = pt.patch_cells(pi0_tiny, pair, cell), pi0_tiny.act([pair.clean], [pair.seed])[0]  # type: ignore[list-item]
    every = np.eye(96)
    np.testing.assert_allclose(pt.patch_cells(pi0_tiny, pair, cell, along=every), full_patch, atol=1e-5)
    np.testing.assert_allclose(
        pt.patch_cells(pi0_tiny, pair, cell, along=every, complement=True), clean, atol=1e-5
    )
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(96, 40)))[0].T
    within, image = torch.from_numpy(basis.T @ basis).float(), slice(0, 36)
    _, source = pt.run_with_cache(pi0_tiny, pair.source, pair.seed, ["backbone.02"])

    def write(activation: torch.Tensor, _: pt.HookPoint, complement: bool) -> torch.Tensor:
        difference = source["backbone.02.residual"][:, image] - activation[:, image]
        part = difference @ within
        activation[:, image] += difference - part if complement else part
        return activation

    for complement in (False, True):
        by_hand = pt.run_with_hooks(
            pi0_tiny,
            pair.clean,
            {"backbone.02": lambda activation, at, complement=complement: write(activation, at, complement)},
            3,
        )
        patched = pt.patch_cells(pi0_tiny, pair, cell, along=basis, complement=complement)
        np.testing.assert_allclose(patched, by_hand, atol=1e-5)
        assert np.abs(np.asarray(patched) - full_patch).max() > 1e-4


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
    assert [str(cell) for cell in cells[:2]] == ["backbone.00 all", "backbone.00 image"]
    assert str(cells[8]) == "backbone.01.heads.0 all"
    assert pt.all_but(cells, cells[:16]) == (cells[16],)


@pytest.mark.parametrize(
    ("pattern", "error", "reason"),
    [
        ("backbone.02|state", UsageError, "no token of backbone has the role 'state'; expected one of all, image"),
        ("backbone.02|image.top", UsageError, "no token of backbone has the role 'image.top'"),
        ("backbone.99|image", UnknownSiteError, r"backbone\.99 is no place"),
        ("", UnknownSiteError, "names no place"),
    ],
)
def test_a_cell_that_is_not_there_is_refused(
    pi0_tiny: Pi0, pattern: str, error: type[Exception], reason: str
) -> None:
    with pytest.raises(error, match=reason):
        pt.find_cells(pi0_tiny, pattern)


def test_an_impossible_patch_is_refused(pi0_tiny: Pi0, pair: pt.Pair) -> None:
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


def test_shares_by_role_are_sums_of_weights(pi0_tiny: Pi0, observation: Observation) -> None:
    patterns = pt.attention_patterns(pi0_tiny, observation, ["expert.02.heads@9", "backbone.*.heads"], seed=1)
    assert len(patterns) == 4
    head_pattern = patterns[Site("expert", 2, "heads", 9)]
    assert head_pattern.weights.shape == (8, 17, 69)
    assert head_pattern.queries is not None
    assert head_pattern.keys is not None
    np.testing.assert_allclose(head_pattern.weights.sum(axis=-1), 1, atol=1e-5)
    by_hand = head_pattern.weights[:, 1:, :36].sum(axis=2).mean(axis=1)
    np.testing.assert_allclose(head_pattern.mean_share("image", "action"), by_hand, rtol=1e-5)
    roles = ("image", "language", "special", "state", "action")
    np.testing.assert_allclose(sum(head_pattern.mean_share(role) for role in roles), 1, atol=1e-5)
    prompt = patterns[Site("backbone", 0, "heads")]
    assert prompt.mean_share("padding").max(initial=0) == 0
    with pytest.raises(EmptyRoleError, match="no token with the role 'image' attends here"):
        head_pattern.mean_share("language", "image")


def test_a_vision_tower_has_weights_without_roles(pi0_tiny: Pi0, observation: Observation) -> None:
    (head_pattern,) = pt.attention_patterns(pi0_tiny, observation, ["vision.00.heads"]).values()
    assert head_pattern.queries is head_pattern.keys is None
    np.testing.assert_allclose(head_pattern.weights.sum(axis=-1), 1, atol=1e-5)
    with pytest.raises(EmptyRoleError, match="have no roles; use weights"):
        head_pattern.mean_share("image")


def test_a_question_is_attended_to_by_its_answer(observation: Observation) -> None:
    vlm = load_model("vlm-tiny")
    question = Prompt(observation, "Put cube on red shape\n\nA left\nB right", ("A", "B"))
    (head_pattern,) = pt.attention_patterns(vlm, question, ["answer.02.heads"]).values()
    assert head_pattern.weights.shape[1] == 1
    shares = [head_pattern.mean_share(role, "answer") for role in ("image", "language", "special", "answer")]
    np.testing.assert_allclose(sum(shares), 1, atol=1e-5)


def test_another_quantity_is_refused(pi0_tiny: Pi0, observation: Observation) -> None:
    with pytest.raises(UnknownSiteError, match="has no attention pattern"):
        pt.attention_patterns(pi0_tiny, observation, ["backbone.01"])
