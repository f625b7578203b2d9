"""The contributions of single attention heads, each through the block's own output projection."""

import torch
from torch import Tensor

from probe_kit.errors import UnknownSiteError
from probe_kit.hooks.capturing.activation_cache import ActivationCache
from probe_kit.hooks.contract.model import Model
from probe_kit.hooks.contract.sites import HEADS, Site


def project_heads(model: Model, cache: ActivationCache, site: Site | str) -> Tensor:
    """(H, B, T, D): what the output projection makes of every head alone, without its bias.

    cache: holds `site`, of the quantity `heads`. The sum over heads, plus the bias, is the projection's output:
    the site `attention`, where the family has no norm, scale or gate behind the projection. Raises
    UnknownSiteError for another quantity, or a site that was not captured.
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
