"""The lens of the last layer is the output, exactly; every layer is the plain norm and head of transformers."""

import numpy as np
import pytest
import torch

from probe_kit.errors import UnknownSiteError, UnsupportedInterventionError, UsageError
from probe_kit.hooks import (
    ActivationCache,
    AnswerModel,
    Observation,
    Prompt,
    Reading,
    capture,
    load_model,
    logit_lens,
)
from probe_kit.hooks.families.paligemma.adapter import PaliGemma
from probe_kit.hooks.families.pi0.adapter import Pi0

TEXT = (
    "Put cube on red shape\n\nA left\nB right\n\nAnswer with the option's letter from the given choices directly."
)


@pytest.fixture(scope="module")
def vlm() -> PaliGemma:
    found = load_model("vlm-tiny")
    assert isinstance(found, PaliGemma)
    return found


@pytest.fixture
def read(vlm: PaliGemma, observation: Observation) -> tuple[ActivationCache, Reading]:
    with capture(vlm, vlm.sites()) as cache:
        reading = vlm.read([Prompt(observation, TEXT, ("A", "B"))])
    return cache, reading


def test_the_last_row_is_the_output_exactly(vlm: PaliGemma, read: tuple[ActivationCache, Reading]) -> None:
    cache, reading = read
    vocabulary = range(int(vlm.text_config.vocab_size))
    lens = logit_lens(vlm, cache, vocabulary)
    assert lens.layers == (0, 1, 2, 3)
    assert lens.logits.shape == (4, 1, len(vocabulary))
    assert np.isin(reading.option_logits, lens.logits[-1]).all()
    assert np.array_equal(lens.logits[-1], reading.state.logits.float().numpy())


@pytest.mark.parametrize(("stream", "at"), [("answer", -1), ("backbone", 5)])
def test_every_layer_is_final_norm_and_head_of_its_residual(
    vlm: PaliGemma, read: tuple[ActivationCache, Reading], stream: str, at: int
) -> None:
    cache, _ = read
    lens = logit_lens(vlm, cache, ids=(7, 3), at=at, stream=stream)
    language = vlm.network.model.language_model
    for layer, residual in enumerate(cache.stack(stream)):
        with torch.inference_mode():
            plain = vlm.network.lm_head(language.norm(residual.reshape(-1, 1, residual.shape[-2], 96)[0, :, at]))
        np.testing.assert_allclose(lens.logits[layer], plain[:, [7, 3]].numpy(), rtol=1e-5, atol=1e-5)


def test_without_ids_the_likeliest_tokens_of_every_layer_come_first(
    vlm: PaliGemma, read: tuple[ActivationCache, Reading]
) -> None:
    cache, _ = read
    lens = logit_lens(vlm, cache, k=3)
    every = logit_lens(vlm, cache, range(int(vlm.text_config.vocab_size))).logits
    assert (lens.logits[..., 0] == every.max(axis=-1)).all()
    assert (np.diff(lens.logits, axis=-1) <= 0).all()
    assert (np.take_along_axis(every, lens.ids, axis=-1) == lens.logits).all()


def test_what_cannot_be_is_refused(vlm: AnswerModel, read: tuple[ActivationCache, Reading], pi0_tiny: Pi0) -> None:
    cache, _ = read
    with pytest.raises(UsageError, match=r"ids are \[-1\]; expected one or more from 0 to"):
        logit_lens(vlm, cache, [-1])
    with pytest.raises(UsageError, match=r"ids are \[\]"):
        logit_lens(vlm, cache, [])
    with pytest.raises(
        UnknownSiteError, match="does not read the stream 'vision'; expected one of backbone, answer"
    ):
        logit_lens(vlm, cache, stream="vision")
    with pytest.raises(UnknownSiteError, match=r"no residual of answer at iteration 4 was captured; capture"):
        logit_lens(vlm, cache, iteration=4)
    with pytest.raises(UnknownSiteError, match=r"no residual of answer was captured"):
        logit_lens(vlm, ActivationCache())
    with pytest.raises(UnsupportedInterventionError, match="pi0-tiny has no logit lens: it puts out no tokens"):
        logit_lens(pi0_tiny, cache)
