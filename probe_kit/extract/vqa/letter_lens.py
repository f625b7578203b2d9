"""Logit lens of an answer by letter: the margin of left over right at every layer."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureError

if TYPE_CHECKING:
    from probe_kit.hooks import AnswerModel


def letter_margins(
    model: "AnswerModel", residuals: NDArray[np.float32], letters: NDArray[Any], margin: float
) -> list[float]:
    """Logit of the letter for left minus that for right, by the model's own final norm and head, at every layer.

    residuals: (L, D) float32 of the position that chooses the letter. letters: (2,) token ids, left and right.
    margin: the same of the model's own answer, which the last layer must give but for rounding. One layer at a
    time, so that no batch changes a number. Raises CaptureError if the last layer gives another margin.
    """
    import torch

    from probe_kit.hooks.contract.model import NEAR_TIE

    unembedding, card = model.unembedding, model.card
    assert unembedding is not None
    layers = torch.from_numpy(residuals).to(card.device, getattr(torch, card.dtype))
    left_id, right_id = (int(letter) for letter in letters)
    rows = [unembedding.logits(row[None, None])[0, 0].float() for row in layers]
    margins = [float(row[left_id] - row[right_id]) for row in rows]
    size = max(1.0, float(rows[-1][[left_id, right_id]].abs().max()))
    if abs(margins[-1] - margin) > NEAR_TIE.get(card.dtype, NEAR_TIE["bfloat16"]) * size:
        raise CaptureError(
            f"the logit lens gives {margins[-1]:.4g} as the margin of {card.family}'s last layer; the model "
            f"answered with {margin:.4g}. Correct `Model.unembedding`: its streams, final norm and head"
        )
    return margins
