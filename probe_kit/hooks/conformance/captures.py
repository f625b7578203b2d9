"""Checks of captures and edits: sites, attention heads, patterns, the logit lens, batches, token roles.

A stream that declares no heads refuses them by name, and so does a model that puts out no tokens.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import (
    CaptureError,
    ObservationError,
    SiteNeverFiredError,
    UnknownSiteError,
    UnsupportedInterventionError,
)
from probe_kit.hooks.capturing.attention import AttentionCut, attended_roles, capture_patterns, cut_attention
from probe_kit.hooks.capturing.capture_context import (
    ActivationCache,
    capture,
    capture_views,
    edit,
    reason_of_change,
    same_bits,
)
from probe_kit.hooks.capturing.readouts import logit_lens, project_heads
from probe_kit.hooks.conformance.check import (
    CheckFailedError,
    SkipTest,
    check,
    expect_refusal,
    require,
    require_bits,
    require_close,
)
from probe_kit.hooks.conformance.subject import Subject
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles, pool, pool_weights
from probe_kit.hooks.contract.sites import HEADS, PADDING, PARTS, Site, Stream, plays, view_names
from probe_kit.hooks.outputs import outputs_of

_SUM = ("residual", "attention", "mlp")


@check(
    "Every stream declares its name, part, label and quantities.",
    "Correct `streams` of the adapter: Stream(name, layers, width, part=…).",
)
def streams_declare_what_they_are(subject: Subject) -> None:
    model = subject.model
    for name, stream in model.every_stream().items():
        require(stream.name == name, f"the stream {stream.name!r} under the key {name!r}", "one name")
        require(stream.part in PARTS, f"{name} has part {stream.part!r}", f"one of {', '.join(PARTS)}")
        require(bool(stream.label), f"{name} has no label", "a label that people read")
        require(
            "residual" in stream.quantities or stream is model.prompt_kv,
            f"{name} has the quantities {', '.join(stream.quantities)}",
            "residual among them",
        )
    require(bool(subject.probed_backbone.layers), "a backbone without layers", "at least one layer")


@check(
    "The sites of a model are complete, ordered and without doubles.",
    "Let `Model.sites` come from the declared streams; count one layer more than there are blocks.",
)
def sites_are_complete_ordered_and_without_doubles(subject: Subject) -> None:
    sites = subject.model.sites()
    require(len(set(sites)) == len(sites) > 0, f"{len(sites)} sites, {len(set(sites))} different", "no doubles")
    for name, stream in subject.model.streams.items():
        stream_sites = [site for site in sites if site.stream == name]
        many = stream.layers * (stream.iterations or 1)
        require(
            stream_sites == stream.sites(),
            f"{name}: {len(stream_sites)} sites in another order",
            "those of Stream.sites()",
        )
        require(
            len(stream_sites) == many, f"{name}: {len(stream_sites)} sites", f"layers times iterations, {many}"
        )


@check(
    "Every site of every quantity fires as often as its tap promises.",
    "Tap the first submodule that a block calls, and correct `fires` or the stream's layers and iterations.",
)
def every_site_of_every_quantity_fires_as_often_as_promised(subject: Subject) -> None:
    streams = subject.model.every_stream().values()
    sites = [site for stream in streams for quantity in stream.captured for site in stream.sites(quantity)]
    with capture(subject.model, sites) as activations:
        subject.run(subject.batch)
    missing = [str(site) for site in sites if site not in activations]
    require(not missing, f"no activation at {', '.join(missing)}", "one at every site")


@check(
    "Activations have the shape (batch, tokens, width) of their stream.",
    "Correct the stream's width, the tap's `tokens` and `view`, or the number of positions in `roles`.",
)
def activations_have_the_shape_of_their_stream(subject: Subject) -> None:
    model, observations = subject.model, subject.batch
    roles = subject.roles_of(observations)
    with capture(model, model.sites()) as activations:
        subject.run(observations)
    require(roles.keys() == model.streams.keys(), f"roles of {list(roles)}", f"roles of {list(model.streams)}")
    for name, stream in model.streams.items():
        lengths = {len(row) for row in roles[name]}
        require(len(lengths) == 1, f"rows of {name} with {sorted(lengths)} positions", "equally long rows")
        expected = (len(observations), *lengths, stream.width)
        for site in stream.sites():
            shape = tuple(activations[site].shape)
            require(shape == expected, f"{site} has the shape {shape}", f"{expected}")


@check(
    "What the blocks add makes the next residual: residual + attention + mlp = residual of the next layer.",
    "Tap `attention` and `mlp` where they are added, or declare the stream with sums=False.",
)
def what_blocks_add_makes_the_next_residual(subject: Subject) -> None:
    """Compare the sum in every stream that declares all three quantities, those of vision towers too."""
    subject.require_float32()
    observations, roles = subject.batch, subject.roles_of(subject.batch)
    streams = {**subject.model.streams, **subject.model.further_streams}
    summing = {
        name: stream for name, stream in streams.items() if stream.sums and set(_SUM) <= set(stream.quantities)
    }
    sites = [site for stream in summing.values() for quantity in _SUM for site in stream.sites(quantity)]
    if not sites:
        return
    with capture(subject.model, sites) as activations:
        subject.run(observations)
    for name, stream in summing.items():
        # A tower has no roles: all of its positions are of pictures.
        valid = torch.from_numpy(np.stack([row.valid for row in roles[name]])) if name in roles else ...
        for site in stream.sites("attention"):
            parts = [activations[replace(site, quantity=quantity)].double().cpu() for quantity in _SUM]
            following = activations[replace(site, layer=site.layer + 1, quantity="residual")].double().cpu()
            apart = float((parts[0] + parts[1] + parts[2] - following)[valid].abs().max())
            limit = subject.tolerance * (1 + float(following[valid].abs().max()))
            require(
                apart <= limit, f"at block {site.layer} of {name} the sum is off by {apart:.3g}", f"≤ {limit:.3g}"
            )


@check(
    "Capturing every site changes no output, bit for bit.",
    "Take all randomness from the seeds, and keep no state between calls.",
)
def capturing_changes_no_output_bit_for_bit(subject: Subject) -> None:
    observations = subject.batch

    def capture_site() -> NDArray[np.float32]:
        with capture(subject.model, subject.model.sites()):
            return subject.run(observations)

    plain, hooked = subject.run(observations), capture_site()
    if not same_bits(plain, hooked):
        raise CheckFailedError(
            f"the outputs with and without hooks differ by up to {np.abs(plain - hooked).max():.3g}",
            "no difference, bit for bit",
            reason_of_change(lambda: subject.run(observations), plain, capture_site),
        )


@check(
    "What is kept of a whole pass equals what is copied as each site fires, bit for bit.",
    "Write a tensor that entered a block at every inference or at none: the first capture learns which they are.",
)
def passes_keep_what_fires(subject: Subject) -> None:
    model, observations = subject.model, subject.batch
    streams = model.every_stream().values()
    sites = [site for stream in streams for quantity in stream.captured for site in stream.sites(quantity)]
    roles = subject.roles_of(observations)
    names = {name: view_names(model.role_names[name]) for name in model.streams}
    weights = {name: pool_weights(roles[name], names[name], model.card.device) for name in names}
    with capture(model, sites, reduce=lambda _, activation: activation.clone()) as fired:
        subject.run(observations)
    for _ in range(2):  # the first capture of a kind learns what is written in place
        with capture(model, sites) as passed:
            subject.run(observations)
        with capture_views(model, model.sites(), weights) as pooled:
            subject.run(observations)
    written = [str(site) for site in sites if not torch.equal(passed[site], fired[site])]
    require(not written, f"other activations at {', '.join(written[:5])}", "those that passed, bit for bit")
    for site in model.sites():
        rows = zip(fired[site], roles[site.stream], strict=True)
        alone = torch.stack([pool(tokens, row, names[site.stream]) for tokens, row in rows])
        # The order of a sum may be another one in a product of few numbers.
        apart = float((pooled.views[site] - alone).abs().max())
        require(apart <= 1e-6 * (1 + float(alone.abs().max())), f"views of {site} off by {apart:.3g}", "≤ 1e-6")


@check(
    "Hooks are gone after an exception inside a capture.",
    "Register no hooks of your own, and keep no state between calls.",
)
def hooks_are_gone_after_an_exception(subject: Subject) -> None:
    model, observations = subject.model, subject.batch
    plain = subject.run(observations)
    with expect_refusal("an exception in a capture", KeyError, says="body"), capture(model, model.sites()):
        raise KeyError("body")
    require_bits(subject.run(observations), plain, "outputs after the exception", "those before it")
    with expect_refusal("a capture without an inference", SiteNeverFiredError), capture(model, model.sites()[:1]):
        pass


@check(
    "A capture inside a capture of the same model is refused.",
    "Let `tap` name modules of this model only.",
)
def nested_captures_are_refused(subject: Subject) -> None:
    model, sites = subject.model, subject.model.sites()[:1]
    with capture(model, sites):
        with expect_refusal("a capture inside a capture", CaptureError), capture(model, sites):
            pass
        subject.run(subject.batch)


@check(
    "A site that the model does not have is refused.",
    "Call `self.stream_of(site)` first in `tap`; it raises UnknownSiteError.",
)
def an_unknown_site_is_refused(subject: Subject) -> None:
    stream = next(iter(subject.model.streams))
    for site in (Site(stream, 999), Site(stream, 0, "nonsense"), Site("nowhere", 0)):
        with expect_refusal(f"tap({site})", UnknownSiteError):
            subject.model.tap(site)


# -- edits ----------------------------------------------------------------------------------------------------


@check(
    "Rewriting a site with itself changes no output, and zeros in its place do.",
    "Tap the tensor that the block itself reads, not a copy: an edit is written into that tensor.",
)
def an_identity_edit_changes_nothing_and_zeroing_changes_the_output(subject: Subject) -> None:
    model, observations = subject.model, subject.batch
    plain = subject.run(observations)
    for stream in model.streams.values():
        if not stream.probed:
            continue
        site = stream.sites()[1]
        with edit(model, {site: lambda activation: activation}):
            same = subject.run(observations)
        require_bits(same, plain, f"outputs with {site} rewritten by itself", "those without")
        with edit(model, dict.fromkeys(_everywhere(stream, site), torch.zeros_like)):
            changed = subject.run(observations)
        require(
            bool(np.abs(changed - plain).max() > 0),
            f"zeros at {site} change no output",
            "other outputs: the stream is on the way to them",
        )
    require_bits(subject.run(observations), plain, "outputs after the edits", "those before")


def _everywhere(stream: Stream, site: Site) -> list[Site]:
    """The site at every iteration: one action token of several may decide nothing that is printed."""
    return [candidate for candidate in stream.sites() if candidate.layer == site.layer]


@check(
    "A capture inside an edit reads what the edit left.",
    "Let a site be read and written at the same end of one module.",
)
def an_edit_is_what_a_capture_inside_it_reads(subject: Subject) -> None:
    model, site = subject.model, subject.model.sites()[1]
    with edit(model, {site: torch.zeros_like}), capture(model, [site]) as activations:
        subject.run(subject.batch)
    most = float(activations[site].abs().max())
    require(most == 0, f"{site} holds values up to {most:.3g} behind an edit to zeros", "zeros")


# -- attention heads ------------------------------------------------------------------------------------------

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
        with capture(subject.model, sites) as activations:
            subject.run(subject.batch)
    for site, tap in taps.items():
        projected = tap.rows.of(put_out[site][tap.first + (site.iteration or 0)])[:, tap.tokens]
        width, heads = activations[site].shape[-1], subject.model.stream_of(site).heads
        require(width % heads == 0, f"{site} has {width} features", f"a multiple of its {heads} heads")
        added, bias = project_heads(subject.model, activations, site).sum(dim=0), getattr(tap.module, "bias", None)
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


@check(
    "A cut of attention to no token changes no bit.",
    "Tap `heads` directly behind the attention, which torch computes, so that it can be computed once more.",
)
def a_cut_of_attention_to_no_token_changes_nothing(subject: Subject) -> None:
    subject.require_float32()
    model, observations = subject.model, subject.batch[:1]
    sites = [site for stream in _streams_with_heads(subject) for site in stream.sites(HEADS)]
    plain = subject.run(observations)
    with cut_attention(model, dict.fromkeys(sites, AttentionCut(np.zeros(1, bool)))) as log:
        require_bits(subject.run(observations), plain, "outputs with attention cut to no token", "those without")
    require(log.no_op_fires == log.fires > 0, f"{log.no_op_fires} of {log.fires} cuts changed nothing", "all")


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
        with expect_refusal(f"heads of {stream.name}", UnknownSiteError, says=stream.name):
            stream.sites(HEADS)
        site = Site(stream.name, 0, HEADS, None if stream.iterations is None else 0)
        with expect_refusal(f"tap({site})", UnknownSiteError, says=HEADS):
            model.tap(site)


@check(
    "The last row of the logit lens is what the head puts out, bit for bit.",
    "Correct `Model.unembedding`: the streams, the final norm, the head and its soft cap.",
)
def the_last_row_of_the_logit_lens_is_the_output(subject: Subject) -> None:
    model, unembedding = subject.model, subject.model.unembedding
    if unembedding is None:
        with expect_refusal("a logit lens", UnsupportedInterventionError, says=model.card.family):
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
    """Return the streams that declare heads.

    Raises:
        SkipTest: If there are none.
    """
    streams = [stream for stream in subject.model.every_stream().values() if stream.heads]
    if not streams:
        raise SkipTest(f"{subject.model.card.family} declares no heads")
    return streams


# -- batches --------------------------------------------------------------------------------------------------


@check(
    "A batch gives what its rows give one by one.",
    "Mask padding, and take each row's randomness from its seed; or declare batch=1 in the card.",
)
def a_batch_equals_its_rows_one_by_one(subject: Subject) -> None:
    observations = subject.observations
    if subject.model.card.batch == 1:
        with expect_refusal("two observations where card.batch is 1", ObservationError, says="at most 1"):
            subject.run(observations)
        return
    together = subject.run(observations)
    for row, observation in enumerate(observations):
        alone = subject.run_row(observation, row)
        require_close(together[row], alone, subject.tolerance, f"numbers of row {row} in a batch")


@check(
    "An observation without what the card needs is refused.",
    "Call `self.check(observations, seeds)` first in `act` or `read`, and name inputs in the card's `needs`.",
)
def an_observation_without_what_is_needed_is_refused(subject: Subject) -> None:
    bare = replace(subject.observations[0], intrinsics=None, cameras={})
    if not subject.model.card.needs - {"state"}:
        subject.run([bare])
        return
    with expect_refusal("an observation without cameras and intrinsics", ObservationError, says="reads"):
        subject.run([bare])


# -- token roles ----------------------------------------------------------------------------------------------


@check(
    "Roles cover every position and are the declared ones.",
    "Name every role of `roles` in `role_names`, and call no whole row padding.",
)
def roles_cover_every_position_and_are_the_declared_ones(subject: Subject) -> None:
    for name, rows in subject.roles_of(subject.batch).items():
        declared = set(subject.model.role_names[name])
        for row in rows:
            roles = {span.role for span in row.spans}
            require(roles <= declared, f"{name} has the roles {sorted(roles)}", f"some of {sorted(declared)}")
            require(bool(row.valid.any()), f"a row of {name} is padding only", "at least one token")


@check(
    "At the embeddings, another picture changes only tokens with the role `image`.",
    "Correct the order and the numbers of positions in `roles`.",
)
def another_picture_moves_image_positions_only(subject: Subject) -> None:
    observation = subject.observations[0]
    _require_moves(subject, observation, replace(observation, image=255 - observation.image), "image")


@check(
    "At the embeddings, another instruction changes only tokens with the role `language`.",
    "Correct the order and the numbers of positions in `roles`.",
)
def another_instruction_moves_language_positions_only(subject: Subject) -> None:
    observation, other = _alike(subject, subject.alike)
    _require_moves(subject, observation, replace(observation, instruction=other.instruction), "language")


def _alike(subject: Subject, candidates: Sequence[Observation]) -> tuple[Observation, Observation]:
    """Return the first two observations whose instructions have equally many tokens."""
    name = subject.probed_backbone.name
    for observation, other in combinations(candidates, 2):
        if (
            subject.roles_of([observation])[name]
            == subject.roles_of([replace(observation, instruction=other.instruction)])[name]
        ):
            return observation, other
    raise CheckFailedError(
        f"no two of the instructions {[candidate.instruction for candidate in candidates]} "
        "have equally many tokens",
        "two that have, so that positions can be compared",
        "Give such instructions: `--instruction` of the command, the fixture `alike` of the contract class.",
    )


def _require_moves(subject: Subject, first: Observation, second: Observation, role: str) -> None:
    """Check that between two observations with the same roles, only embeddings of `role` differ, and some do."""
    stream = subject.probed_backbone
    before: Roles = subject.roles_of([first])[stream.name][0]
    site, embeddings = stream.sites()[0], []
    for observation in (first, second):
        with capture(subject.model, [site]) as activations:
            subject.run([observation])
        embeddings.append(activations[site][0].float().cpu())
    moved = (embeddings[0] != embeddings[1]).any(dim=1).numpy() & before.valid
    require(bool(moved.any()), f"another {role} changes nothing at {site}", f"other embeddings of the {role}")
    labels = {span.role for span in before.spans if moved[span.start : span.stop].any()}
    require(
        all(plays(label, role) for label in labels),
        f"another {role} changes positions with the roles {', '.join(sorted(labels))}",
        f"changes at positions with the role {role} only",
    )


@check(
    "Padding enters no pooled view.",
    "Give padded positions the role `padding`.",
)
def padding_is_never_pooled(subject: Subject) -> None:
    for name, rows in subject.roles_of(subject.batch).items():
        for row in rows:
            tokens = torch.ones(len(row), 2)
            tokens[torch.from_numpy(row.mask(PADDING))] = 1e9
            present = {span.role for span in row.spans}
            views = view_names([role for role in subject.model.role_names[name] if role in present])
            pooled = pool(tokens, row, views)
            require(bool((pooled < 2).all()), f"padding enters a view of {name}", "views of real tokens only")
