"""Caches and hooks of one inference are those of plain torch, in policies and in models that answer."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from probe_kit import patching as pt
from probe_kit.errors import CaptureError, UnknownSiteError, UsageError
from probe_kit.hooks import AnswerModel, Observation, Prompt, Reading, Site, load_model
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.intervene.patching.inference import infer


@pytest.fixture(scope="module")
def vlm() -> AnswerModel:
    found = load_model("vlm-tiny")
    assert isinstance(found, AnswerModel)
    return found


@pytest.fixture
def question(observation: Observation) -> Prompt:
    return Prompt(observation, "Put cube on red shape\n\nA left\nB right", ("A", "B"))


def test_the_cache_holds_what_plain_hooks_read_and_the_output_is_the_plain_one(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    output, cache = pt.run_with_cache(pi0_tiny, observation, 7)
    np.testing.assert_array_equal(output, pi0_tiny.act([observation], [7])[0])
    assert set(cache) == set(pi0_tiny.sites())
    kept: list[torch.Tensor] = []
    module = pi0_tiny.tap(Site("expert", 1, iteration=0)).module
    handle = module.register_forward_pre_hook(lambda _, inputs: kept.append(inputs[0].clone()))
    pi0_tiny.act([observation], [7])
    handle.remove()
    for step, own in enumerate(kept):
        assert torch.equal(cache[f"expert.01.residual@{step}"], own)


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
    seen: list[int | None] = []

    def note(activation: torch.Tensor, point: pt.HookPoint) -> torch.Tensor:
        seen.append(point.iteration)
        return activation

    same = pt.run_with_hooks(pi0_tiny, observation, {"expert.02@3-5": note, "vision.00": note}, 7)
    assert seen == [0, 3, 4, 5], "the first camera, then three steps"
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


def test_what_does_not_fit_the_model_is_refused(
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
            pi0_tiny, observation, {"backbone.*": lambda own, _: own, "backbone.01": lambda own, _: own}
        )
    with pytest.raises(CaptureError, match=r"the edit of backbone\.01\.residual returned .*; expected"):
        pt.run_with_hooks(pi0_tiny, observation, {"backbone.01": lambda own, _: own[:, :3]})


def test_the_names_are_found_without_torch() -> None:
    code = "import sys; from probe_kit import patching as pt; print(len(pt.__all__), 'torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True)
    assert found.stdout.split() == [str(len(pt.__all__)), "False"]
