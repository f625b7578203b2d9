"""Checks of attention heads, attention patterns and the logit lens.

A stream that declares no heads refuses them by name, and so does a model that puts out no tokens.
"""

from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np
import torch
from torch import Tensor

from probe_kit.errors import UnknownSiteError, UnsupportedInterventionError
from probe_kit.hooks.capturing.activation_cache import ActivationCache
from probe_kit.hooks.capturing.attention_patterns import attended_roles, capture_patterns
from probe_kit.hooks.capturing.capture_context import capture
from probe_kit.hooks.capturing.head_outputs import project_heads
from probe_kit.hooks.capturing.logit_lens import logit_lens
from probe_kit.hooks.conformance.check import SkipTest, check, refused, require, require_bits
from probe_kit.hooks.conformance.subject import Subject
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import HEADS, Site, Stream
from probe_kit.hooks.verification.outputs import outputs_of

_SUM_TOLERANCE = 1e-5


@check(
    "The heads of a block, each through the output projection, make what the projection adds.",
    "Tap `heads` at the input of the module that projects them, and correct `Stream.heads`.",
)
def heads_make_what_the_output_projection_adds(subject: Subject) -> None:
    subject.require_float32()
    sites = [
        site
        for stream in _streams_with_heads(subject)
        for site in (stream.sites(HEADS)[0], stream.sites(HEADS)[-1])
    ]
    taps = {site: subject.model.tap(site) for site in sites}
    with ExitStack() as stack:
        put_out = {site: outputs_of(tap.module, stack) for site, tap in taps.items()}
        with capture(subject.model, sites) as tape:
            subject.run(subject.batch)
    for site, tap in taps.items():
        projected = tap.rows.of(put_out[site][tap.first + (site.iteration or 0)])[:, tap.tokens]
        width, heads = tape[site].shape[-1], subject.model.stream_of(site).heads
        require(width % heads == 0, f"{site} has {width} features", f"a multiple of its {heads} heads")
        added, bias = project_heads(subject.model, tape, site).sum(dim=0), getattr(tap.module, "bias", None)
        apart = float((added + (0 if bias is None else bias.detach()) - projected).abs().max())
        limit = subject.tolerance * (1 + float(projected.abs().max()))
        require(apart <= limit, f"the heads of {site} are off by {apart:.3g}", f"at most {limit:.3g}")


@check(
    "Attention patterns give what the heads read, their rows are shares, and no output changes.",
    "Tap `heads` directly behind the attention, which torch computes; declare the right number of heads.",
)
def attention_patterns_are_the_models_own(subject: Subject) -> None:
    subject.require_float32()
    observations, streams = subject.batch, _streams_with_heads(subject)
    plain = subject.run(observations)
    with capture_patterns(subject.model, [site for stream in streams for site in stream.sites(HEADS)]) as patterns:
        captured = subject.run(observations)
    require_bits(captured, plain, "outputs with attention patterns captured", "those without")
    roles = subject.roles_of(observations)
    for site, pattern in patterns.items():
        require(bool((pattern >= 0).all()), f"{site}: negative attention", "shares from 0 on")
        if site.stream in roles:
            keys = attended_roles(subject.model, roles, site, pattern.shape[-1])
            _require_shares_of_valid_tokens(site, pattern, roles[site.stream], keys)


def _require_shares_of_valid_tokens(
    site: Site, pattern: Tensor, queries: Sequence[Roles], keys: Sequence[Roles]
) -> None:
    """Raise CheckFailedError unless the attention of a real token sums to 1, and none of it is on padding."""
    for row, asking, attended in zip(pattern, queries, keys, strict=True):
        shares = row[:, torch.from_numpy(asking.valid)]
        apart = float((shares.sum(dim=-1) - 1).abs().max())
        require(apart <= _SUM_TOLERANCE, f"{site}: sums of attention off 1 by {apart:.3g}", f"≤ {_SUM_TOLERANCE}")
        lost = float(shares[..., torch.from_numpy(~attended.valid)].sum())
        require(lost == 0, f"{site}: {lost:.3g} of the attention lies on padding", "none")


@check(
    "Heads of a stream that declares none are refused by name.",
    "Leave `heads` out of a Stream whose blocks have no output projection that a hook can reach.",
)
def heads_that_are_not_declared_are_refused_by_name(subject: Subject) -> None:
    model, none = (
        subject.model,
        [declared for declared in subject.model.every_stream().values() if not declared.heads],
    )
    if not none:
        raise SkipTest(f"every stream of {model.card.family} declares heads")
    for stream in none:
        with refused(f"heads of {stream.name}", UnknownSiteError, says=stream.name):
            stream.sites(HEADS)
        site = Site(stream.name, 0, HEADS, None if stream.iterations is None else 0)
        with refused(f"tap({site})", UnknownSiteError, says=HEADS):
            model.tap(site)


@check(
    "The last row of the logit lens is what the head puts out, bit for bit.",
    "Correct `Model.unembedding`: the streams, the final norm, the head and its soft cap.",
)
def the_last_row_of_the_logit_lens_is_the_output(subject: Subject) -> None:
    model, unembedding = subject.model, subject.model.unembedding
    if unembedding is None:
        with refused("a logit lens", UnsupportedInterventionError, says=model.card.family):
            logit_lens(model, ActivationCache())
        raise SkipTest(f"{model.card.family} puts out no tokens, and refuses a logit lens by name")
    streams = set(unembedding.streams)
    require(
        streams <= model.streams.keys(), f"unembedded streams {sorted(streams)}", f"some of {[*model.streams]}"
    )
    stream = model.streams[unembedding.streams[-1]]
    with ExitStack() as stack:
        put_out = outputs_of(unembedding.head, stack)
        with capture(model, stream.sites()) as cache:
            subject.run(subject.single)
    for iteration in range(stream.iterations or 1):
        expected = unembedding.capped(put_out[iteration][:, -1]).float().cpu().numpy()
        every = range(expected.shape[-1])
        lens = logit_lens(model, cache, every, iteration=None if stream.iterations is None else iteration)
        require_bits(lens.logits[-1], expected, f"logits of the last layer of {stream.name}", "the output")
        require(
            bool(np.isfinite(lens.logits).all()) and lens.layers == tuple(range(stream.layers)),
            f"layers {lens.layers}, {np.isfinite(lens.logits).mean():.0%} finite",
            f"0 to {stream.layers - 1}, all finite",
        )


def _streams_with_heads(subject: Subject) -> list[Stream]:
    """Raises SkipTest if there are none."""
    streams = [stream for stream in subject.model.every_stream().values() if stream.heads]
    if not streams:
        raise SkipTest(f"{subject.model.card.family} declares no heads")
    return streams
