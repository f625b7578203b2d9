"""Activations through the model's own projections: contributions of single heads, and the logit lens.

The logit lens shows what tokens a layer would put out if no layer came after it. It does not show what later
layers read there (nostalgebraist, 2020).

    with capture(model, model.streams["answer"].sites()) as cache:
        model.read([question])
    logit_lens(model, cache).ids  # the five likeliest tokens of every layer
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import UnknownSiteError, UnsupportedInterventionError, UsageError
from probe_kit.hooks.capturing.capture_context import ActivationCache
from probe_kit.hooks.contract.model import Model
from probe_kit.hooks.contract.sites import HEADS, Site


def project_heads(model: Model, cache: ActivationCache, site: Site | str) -> Tensor:
    """Return what the output projection makes of every head alone, without its bias.

    The sum over heads, plus the bias, is the projection's output. That is the site `attention`, where the family
    has no norm, scale or gate behind the projection.

    Args:
        model: The model whose activations the cache holds.
        cache: The activations of one inference, with those of `site`.
        site: A site of the quantity `heads`, or its name.

    Returns:
        (H, B, T, D), in the dtype and on the device of the captured activation.

    Raises:
        UnknownSiteError: For another quantity, or a site that was not captured.
    """
    heads_site = Site.parse(site) if isinstance(site, str) else site
    if heads_site.quantity != HEADS:
        raise UnknownSiteError(
            f"{heads_site} is not of heads; expected {heads_site.stream}.{heads_site.layer:02d}.{HEADS}"
        )
    count, projection = model.stream_of(heads_site).heads, model.tap(heads_site).module
    passing = cache[heads_site]
    read = passing.view(*passing.shape[:2], count, -1)
    alone = torch.zeros(count, *read.shape, dtype=read.dtype, device=read.device)
    for head in range(count):
        alone[head, :, :, head] = read[:, :, head]
    with torch.inference_mode():
        added: Tensor = projection(alone.flatten(3))
        bias = getattr(projection, "bias", None)
        return added if bias is None else added - bias


# -- the logit lens -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LogitLens:
    """The tokens that the layers of one stream would put out.

    Attributes:
        layers: (L,) of the residuals; the last one is the output of the model, if its last residual was captured.
        ids: (L, B, K) of tokens; the same tokens in every layer if they were given, else the likeliest first.
        logits: (L, B, K) of these tokens.
    """

    layers: tuple[int, ...]
    ids: NDArray[np.int64]
    logits: NDArray[np.float32]


def logit_lens(
    model: Model,
    cache: ActivationCache,
    ids: Sequence[int] | None = None,
    k: int = 5,
    at: int = -1,
    stream: str = "",
    iteration: int | None = None,
) -> LogitLens:
    """Apply the final norm and head of the model to every captured residual of one stream.

    Args:
        model: The model whose activations the cache holds.
        cache: The activations of one inference, with residuals of the stream.
        ids: Tokens whose logits are wanted; None takes the k likeliest of every layer.
        k: Count of the likeliest tokens; without effect where `ids` are given.
        at: Position in the stream.
        stream: Name of the stream; "" takes the one whose last residual chooses tokens.
        iteration: Iteration of the stream; None takes the first.

    Raises:
        UnsupportedInterventionError: For a model that puts out no tokens.
        UnknownSiteError: If no residual of the stream was captured.
        UsageError: For ids that the model does not have.
    """
    unembedding = model.unembedding
    if unembedding is None:
        raise UnsupportedInterventionError(
            f"{model.card.family} has no logit lens: it puts out no tokens, so that no head turns its residuals "
            "into logits. Probe its residuals instead, with `probe-kit train`"
        )
    name = stream or unembedding.streams[-1]
    if name not in unembedding.streams:
        raise UnknownSiteError(
            f"the head of {model.card.family} does not read the stream {name!r}; expected one of "
            f"{', '.join(unembedding.streams)}"
        )
    sites = _residuals(cache, name, iteration)
    # One position at a time and one layer at a time, as the model does: other shapes are rounded differently.
    rows = [unembedding.logits(cache[site][:, [at]])[:, 0].float().cpu().numpy() for site in sites]
    every = np.stack(rows)
    if ids is None:
        token_ids = np.argsort(-every, axis=-1, kind="stable")[..., :k]
    elif ids and min(ids) >= 0 and max(ids) < every.shape[-1]:
        token_ids = np.broadcast_to(np.array(ids, np.int64), (*every.shape[:2], len(ids)))
    else:
        raise UsageError(f"ids are {list(ids)}; expected one or more from 0 to {every.shape[-1] - 1}")
    return LogitLens(tuple(site.layer for site in sites), token_ids, np.take_along_axis(every, token_ids, axis=-1))


def _residuals(cache: ActivationCache, stream: str, iteration: int | None) -> list[Site]:
    """The captured residuals of one iteration, shallow before deep."""
    residuals = [site for site in cache if (site.stream, site.quantity) == (stream, "residual")]
    steps = sorted({site.iteration for site in residuals if site.iteration is not None})
    step = steps[0] if iteration is None and steps else iteration
    at_step = sorted(site for site in residuals if site.iteration == step)
    if not at_step:
        raise UnknownSiteError(
            f"no residual of {stream}{'' if step is None else f' at iteration {step}'} was captured; capture "
            f"model.streams[{stream!r}].sites() first"
        )
    return at_step
