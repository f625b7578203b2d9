"""Checks of policies: actions, seeds, and the interventions that `Policy.interventions` declares.

Every declared intervention runs and does what it says; every other one is refused by name. All checks hold by
construction, whatever the weights are.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import ObservationError, UnknownSiteError, UnsupportedInterventionError
from probe_kit.hooks.capturing.attention import capture_attention
from probe_kit.hooks.capturing.capture_context import ActivationCache, EditFunction, capture, edit, gradients_at
from probe_kit.hooks.capturing.edits import Edit, apply_edits, vector_hash
from probe_kit.hooks.conformance.check import SkipTest, check, expect_refusal, require, require_bits, require_close
from probe_kit.hooks.conformance.subject import PolicySubject
from probe_kit.hooks.contract.declared import InterventionKind
from probe_kit.hooks.contract.model import Policy
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import KV, Site, Stream, kv_stream
from probe_kit.hooks.registry import find_family


@check(
    "The action is made in a probed stream with part='action'.",
    "Declare the stream that makes the action, and chunk ≥ execute ≥ 1 in the card.",
)
def the_action_is_made_in_a_stream(subject: PolicySubject) -> None:
    streams, card = subject.policy.streams.values(), subject.policy.card
    acting = [stream.name for stream in streams if stream.part == "action" and stream.probed]
    require(
        bool(acting), f"streams {[stream.name for stream in streams]}", "one with part='action' that is probed"
    )
    require(card.chunk >= card.execute >= 1, f"chunk {card.chunk}, execute {card.execute}", "chunk ≥ execute ≥ 1")


@check(
    "Actions are (batch, chunk, 7) float32, finite, and come from the seed alone.",
    "Return float32 with seven numbers per action, and draw noise from a generator seeded with the row's seed.",
)
def actions_have_the_contracts_shape_and_come_from_the_seed_alone(subject: PolicySubject) -> None:
    policy, observations = _acting(subject), subject.batch
    seeds = [5, 6][: len(observations)]
    torch.manual_seed(1)
    first = policy.act(observations, seeds)
    torch.manual_seed(2)
    require_bits(policy.act(observations, seeds), first, "actions of the same seeds", "those of the first call")
    shape = (len(observations), policy.card.chunk, 7)
    require(first.shape == shape, f"actions of shape {first.shape}", f"{shape}")
    require(first.dtype == np.float32, f"actions of type {first.dtype}", "float32")
    require(bool(np.isfinite(first).all()), "actions that hold NaN or infinity", "finite numbers")


@check(
    "Another seed gives another chunk where noise enters an inference, and the same one where none does.",
    "Pass the noise of the row's seed to the network, and set `draws_noise`. Some packages ignore given noise.",
)
def another_seed_gives_another_chunk_where_noise_is_drawn(subject: PolicySubject) -> None:
    policy = subject.policy
    if policy.draws_noise is None:
        raise SkipTest(f"{policy.card.family} does not say whether noise enters an inference (`draws_noise`)")
    first, other = (subject.run_row(subject.single[0], seed) for seed in (5, 6))
    if policy.draws_noise:
        require(not np.array_equal(first, other), "the same actions of two seeds", "others: the noise is ignored")
    else:
        require_bits(other, first, "actions of another seed", "those of the first, or `draws_noise = True`")


@check(
    "An inference without acting is that of acting, bit for bit at every site.",
    "Let `infer_without_acting` call what `act` calls, with the same inputs.",
)
def inference_without_acting_equals_that_of_acting(subject: PolicySubject) -> None:
    policy, observations = _acting(subject), subject.single
    sites = policy.sites()
    with capture(policy, sites) as acting:
        policy.act(observations, [5])
    with capture(policy, sites) as without_acting:
        raw = policy.infer_without_acting(observations, [5])
    require(raw.shape[0] == 1, f"{raw.shape[0]} rows for one observation", "1")
    for site in sites:
        equal = torch.equal(acting[site], without_acting[site])
        require(equal, f"another activation at {site}", "the same, bit for bit")


@check(
    "Every observation needs a seed of its own.",
    "Call `self.check(observations, seeds)` first in `act`.",
)
def every_observation_needs_its_seed(subject: PolicySubject) -> None:
    with expect_refusal("an observation without a seed", ObservationError):
        subject.policy.act(subject.batch, [])


def _acting(subject: PolicySubject) -> Policy:
    """The policy of the subject.

    Raises:
        SkipTest: For a policy whose actions do not fit this arm.
    """
    if (mismatch := subject.policy.embodiment_mismatch()) is not None:
        raise SkipTest(f"its actions do not fit this arm: {mismatch}")
    return subject.policy


# -- interventions --------------------------------------------------------------------------------------------


@check(
    "Policy and family declare the same interventions.",
    "Name one `Interventions` in the adapter and in its Family, with every stream and its quantities.",
)
def policy_and_family_declare_the_same(subject: PolicySubject) -> None:
    policy, interventions = subject.policy, subject.policy.interventions
    if subject.name:
        declared = find_family(subject.name).abilities.interventions
        require(
            declared == interventions,
            f"the family declares {declared}",
            f"what the policy declares, {interventions}",
        )
    require(
        interventions.prompt_kv == (policy.prompt_kv is not None),
        f"interventions.prompt_kv is {interventions.prompt_kv}, and policy.prompt_kv {policy.prompt_kv}",
        "both, or neither",
    )
    unread, streams = set(interventions.unread), policy.streams
    require(unread <= streams.keys(), f"unread streams {sorted(unread)}", f"some of {sorted(streams)}")
    for name, stream in streams.items():
        if interventions.edits is not None:
            listed = set(interventions.edits.get(name, ()))
            require(listed == set(stream.quantities), f"edits of {name}: {sorted(listed)}", f"{stream.quantities}")


@check(
    "Rewriting every site with itself changes no action, bit for bit.",
    "Tap tensors that can be written in place: no copies, and no views of other memory.",
)
def rewriting_every_site_with_itself_changes_no_action_bit_for_bit(subject: PolicySubject) -> None:
    policy = subject.policy
    streams = [*policy.streams.values(), *([] if policy.prompt_kv is None else [policy.prompt_kv])]
    sites = [site for stream in streams for quantity in stream.captured for site in stream.sites(quantity)]
    plain = subject.run(subject.single)
    with edit(policy, {site: lambda activation: activation for site in sites}):
        same = subject.run(subject.single)
    require_bits(same, plain, "actions with every site rewritten by itself", "those without")


@check(
    "What is rewritten in a block is read behind it.",
    "Tap the tensor that is added to the stream, so that an edit of it reaches the next layer.",
)
def what_is_rewritten_in_a_block_is_read_behind_it(subject: PolicySubject) -> None:
    policy = subject.policy
    for stream in policy.streams.values():
        behind = [site for site in stream.sites() if site.layer == 1]
        plain = _capture_sites(subject, subject.single, behind)
        for quantity in set(stream.captured) - {"final_norm"}:
            written = [site for site in stream.sites(quantity) if site.layer == 0]
            with edit(policy, dict.fromkeys(written, torch.zeros_like)):
                changed = _capture_sites(subject, subject.single, behind)
            reached = any((plain[site] != changed[site]).any() for site in behind)
            require(reached, f"zeros at {stream.name}.00.{quantity} leave layer 1 as it was", "other activations")


@check(
    "An edit at the end of a stream that is declared unread changes no action.",
    "Leave the stream out of `Interventions(unread=…)` if the acting part reads its end.",
)
def the_end_of_an_unread_stream_is_a_control(subject: PolicySubject) -> None:
    policy = subject.policy
    plain = subject.run(subject.single)
    for name in policy.interventions.unread:
        stream = policy.streams[name]
        for quantity in {"residual", "final_norm"} & set(stream.quantities):
            site = stream.sites(quantity)[-1]
            with edit(policy, {site: torch.zeros_like}):
                require_bits(subject.run(subject.single), plain, f"actions with zeros at {site}", "those without")


@check(
    "Interventions that are not supported are refused by name.",
    "Declare what is supported in `Interventions`, and raise UnknownSiteError in `tap` for other sites.",
)
def what_is_not_supported_is_refused_by_name(subject: PolicySubject) -> None:
    policy, family = subject.policy, subject.policy.card.family
    for kind in get_args(InterventionKind):
        if policy.interventions.supports(kind):
            policy.interventions.check(kind, family)
            continue
        with expect_refusal(f"the intervention {kind}", UnsupportedInterventionError, says=family):
            policy.interventions.check(kind, family)
    if policy.prompt_kv is None:
        with expect_refusal("a site of kv", UnknownSiteError):
            policy.tap(kv_stream(1, 1).sites("keys")[0])


# -- kv ----------------------------------------------------------------------------------------------------


@check(
    "The prompt has keys and values for every token of the backbone.",
    "Declare `prompt_kv` with the heads side by side as its width; tap keys and values with a `HeadsTap`.",
)
def the_prompt_has_keys_and_values_for_every_token_of_the_backbone(subject: PolicySubject) -> None:
    kv, observations = _prompt_kv(subject), subject.batch
    sites = _all(kv)
    activations = _capture_sites(subject, observations, sites)
    tokens = len(subject.policy.token_roles(observations)[kv.name][0])
    require(len(activations) == len(sites), f"{len(activations)} of {len(sites)} sites fired", "all")
    expected = (len(observations), tokens, kv.width)
    for site in sites:
        shape = tuple(activations[site].shape)
        require(shape == expected, f"{site} has the shape {shape}", f"{expected}")


@check(
    "All keys and values of another picture give that picture's actions, bit for bit.",
    "Tap the keys and values that the acting part reads, after rotation; correct `first_affected_token`.",
)
def all_keys_and_values_of_another_picture_give_that_pictures_actions(subject: PolicySubject) -> None:
    """Keep state, words and noise the same; what chose the first token is replaced along with keys and values."""
    policy, kv, observation = subject.policy, _prompt_kv(subject), subject.single[0]
    other = replace(observation, image=255 - observation.image)
    acting = [site for site in policy.sites() if policy.streams[site.stream].part == "action"]
    early = [site for site in acting if (site.iteration or 0) < policy.interventions.first_affected_token]
    late = [site for site in acting if site not in early]
    plain, source = (_capture_sites(subject, [picture], [*_all(kv), *acting]) for picture in (observation, other))
    edits, vectors = _edits_from(source, [*_all(kv), *early])
    with apply_edits(policy, edits, [observation], vectors) as edit_log:
        edited = _capture_sites(subject, [observation], late)
    with apply_edits(policy, edits, [observation], vectors):
        moved = subject.run([observation])
    require_bits(moved, subject.run([other]), "actions with keys and values of another picture", "its own actions")
    for site in late:
        require(torch.equal(edited[site], source[site]), f"another activation at {site}", "the other picture's")
    require(
        any((plain[site] != source[site]).any() for site in late),
        "another picture changes nothing in the acting stream",
        "other activations",
    )
    order = [entry.site for entry in edit_log.entries if entry.site.startswith(kv.name)]
    expected = [str(site) for layer in range(kv.layers - 1) for site in _sites_of_kind(kv, layer)]
    require(order == expected, f"edits in the order {order}", f"{expected}")
    require(sum(entry.moved for entry in edit_log.entries) > 0, "edits that move nothing", "other keys and values")


@check(
    "Values of one role are replaced in that role only.",
    "Let the tokens of `kv` be those of the backbone, in the same order.",
)
def values_of_one_role_are_replaced_in_that_role_only(subject: PolicySubject) -> None:
    policy, kv, observation = subject.policy, _prompt_kv(subject), subject.single[0]
    site = _sites_of_kind(kv, 0)[1]
    plain, source = (
        _capture_sites(subject, [picture], [site])[site][0].float().cpu()
        for picture in (observation, replace(observation, image=255 - observation.image))
    )
    replacement = Edit("replace", (site,), roles=("image",), vector=vector_hash(source.numpy()))
    with apply_edits(policy, [replacement], [observation], {replacement.vector: source.numpy()}) as edit_log:
        edited = _capture_sites(subject, [observation], [site])[site][0].float().cpu()
    image = torch.from_numpy(policy.token_roles([observation])[kv.name][0].mask("image"))
    expected = torch.where(image[:, None], source, plain)
    require(torch.equal(edited, expected), f"{site} differs outside of the picture's tokens", "new values there")
    tokens = [entry.tokens for entry in edit_log.entries]
    require(tokens == [int(image.sum())], f"edits of {tokens} tokens", f"[{int(image.sum())}]")


# -- tiles -------------------------------------------------------------------------------------------------


@check(
    "Every token of the picture comes of the patches that are named.",
    "Correct `patch_order`: per token of the vision tower, the picture token it ends in.",
)
def every_token_of_the_picture_comes_of_the_patches_that_are_named(subject: PolicySubject) -> None:
    """Change the tower's output at the patches of one token: that token's embedding moves, and no other."""
    policy, observations = subject.policy, subject.single
    if not policy.interventions.tiles:
        with expect_refusal("patch_order()", UnknownSiteError, says=policy.card.family):
            policy.patch_order()
        raise SkipTest(f"{policy.card.family} declares no tiles, and refuses them by name")
    order, stream = policy.patch_order(), policy.every_stream()["vision"]
    last = next(site for site in stream.sites() if site.layer == stream.layers - 1)
    embedded = next(site for site in policy.sites() if policy.streams[site.stream].part == "backbone")
    picture = np.flatnonzero(policy.roles(observations)["backbone"][0].mask(f"image.{policy.card.cameras[0]}"))
    picture_tokens = set(order.tolist()) - {-1}
    require(
        picture_tokens == set(range(picture.size)),
        f"patch_order names {len(picture_tokens)} tokens",
        f"0 to {picture.size - 1}",
    )
    plain = _capture_sites(subject, observations, [last, embedded])
    tokens = plain[last].shape[-2]
    require(tokens == order.size, f"patch_order of length {order.size}", f"{tokens}, one per token of the tower")
    for token in (0, 1, picture.size // 2, picture.size - 1):
        with edit(policy, {last: _flip_sign(np.flatnonzero(order == token))}):
            changed = _capture_sites(subject, observations, [embedded])
        moved = (changed[embedded] != plain[embedded])[0].any(dim=-1).cpu().numpy()
        reached = np.flatnonzero(moved).tolist()
        require(
            reached == [picture[token]], f"patches of token {token} move positions {reached}", f"{picture[token]}"
        )


# -- attention ---------------------------------------------------------------------------------------------


@check(
    "Recording attention changes no action, and the recorded shares sum to at most 1.",
    "Record softmax weights over all tokens of the backbone, computed in addition where kernels return none.",
)
def attention_is_recorded_without_changing_an_action_bit_for_bit(subject: PolicySubject) -> None:
    policy, observations = subject.policy, subject.batch
    if not policy.interventions.attention:
        with expect_refusal("recorded attention", UnsupportedInterventionError), capture_attention(policy):
            pass
        raise SkipTest(f"{policy.card.family} declares no attention, and refuses it by name")
    plain = subject.run(observations)
    with capture_attention(policy) as mass:
        recorded = subject.run(observations)
    require_bits(recorded, plain, "actions with recorded attention", "those without")
    backbone = subject.probed_backbone
    roles = policy.roles(observations)[backbone.name]
    valid = np.stack([row.valid for row in roles])
    steps = max(stream.iterations or 1 for stream in policy.streams.values() if stream.part == "action")
    blocks, iterations = ({key[at] for key in mass.by_read} for at in (0, 1))
    require(iterations >= set(range(steps)), f"iterations {sorted(iterations)}", f"0 to {steps - 1}")
    require(blocks <= set(range(backbone.layers - 1)), f"blocks {sorted(blocks)}", f"below {backbone.layers - 1}")
    most = 1 + subject.attention_tolerance
    for weights, sums in zip(mass.by_read.values(), mass.on(valid).values(), strict=True):
        require(weights.shape == valid.shape, f"weights of shape {weights.shape}", f"{valid.shape}")
        require(bool((weights >= 0).all()), "negative weights", "weights from 0 on")
        require(bool(((sums > 0) & (sums <= most)).all()), f"shares up to {sums.max():.6g}", "shares in (0, 1]")
        require(np.abs(weights[~valid]).max(initial=0) == 0, "attention to padding", "none")
    shares = mass.of_role(roles, "image").values()
    require(all((share > 0).all() for share in shares), "no attention to the picture", "some, from softmax")


def _flip_sign(positions: NDArray[np.int64]) -> EditFunction:
    """An edit that changes the sign at some positions."""
    indices = torch.from_numpy(positions)

    def turn(passing: torch.Tensor) -> torch.Tensor:
        passing[:, indices] = -passing[:, indices]
        return passing

    return turn


def _prompt_kv(subject: PolicySubject) -> Stream:
    if subject.policy.prompt_kv is None:
        raise SkipTest(f"{subject.policy.card.family} declares no kv stream")
    return subject.policy.prompt_kv


def _capture_sites(
    subject: PolicySubject, observations: Sequence[Observation], sites: Sequence[Site]
) -> ActivationCache:
    """Return the activations of one inference at `sites`."""
    with capture(subject.policy, sites) as activations:
        subject.run(observations)
    return activations


def _sites_of_kind(kv: Stream, layer: int) -> list[Site]:
    return [Site(kv.name, layer, quantity) for quantity in KV]


def _all(kv: Stream) -> list[Site]:
    return [site for quantity in KV for site in kv.sites(quantity)]


def _edits_from(
    source: ActivationCache, sites: Sequence[Site]
) -> tuple[list[Edit], dict[str, NDArray[np.float32]]]:
    """Edits that put in the first row of `source`, and the arrays they name."""
    rows = {site: source[site][0].float().cpu().numpy() for site in sites}
    vectors = {vector_hash(row): row for row in rows.values()}
    return [Edit("replace", (site,), vector=vector_hash(row)) for site, row in rows.items()], vectors


# -- gradients ------------------------------------------------------------------------------------------------

CLOSE = 0.01
"""The largest relative difference of a gradient from a central difference."""
_AGREED = 0.001
"""Relative difference of two central differences below which a shorter step has nothing to decide."""
STEPS = (1e-2, 3e-3, 1e-3)
"""The lengths of steps, relative to the activation's norm, until two agree; of all, the two that agree best."""
_ADVICE = (
    "Let `differentiable` compute what `act` computes: pass by `no_grad` and `inference_mode`, detach nothing, "
    "and keep in-place writes away from tensors that sites tap."
)


@check("Actions with a graph are the actions, and weights need no gradient.", _ADVICE)
def actions_with_a_graph_are_the_actions(subject: PolicySubject) -> None:
    policy = _differentiable(subject)
    trained = [weight.requires_grad for weight in _weights(policy)]
    actions = policy.differentiable(subject.batch, range(len(subject.batch)))
    tolerance = 1e-5 if policy.card.dtype == "float32" else 1e-2
    require_close(actions.detach().cpu().numpy(), subject.run(subject.batch), tolerance, "actions with a graph")
    require(not actions.requires_grad, "a graph behind actions although no site is tapped", "none")
    same = [weight.requires_grad for weight in _weights(policy)] == trained
    require(same, "weights that ask for a gradient", "weights as they were")


@check("Gradients at sites are central differences of the action, whatever other sites are tapped.", _ADVICE)
def gradients_at_sites_are_central_differences(subject: PolicySubject) -> None:
    policy, observations = _differentiable(subject), subject.single
    subject.require_float32()
    sites = _some_sites(policy)
    _, slopes = gradients_at(policy, observations, [0], sites, _lateral)
    with capture(policy, sites) as activations:
        subject.run(observations)
    for site in sites:
        _, alone = gradients_at(policy, observations, [0], [site], _lateral)
        apart = float((alone[site] - slopes[site]).abs().max())
        require(
            apart <= 1e-3 * float(slopes[site].abs().max()),
            f"another gradient at {site} if it is tapped alone",
            "the same",
        )
        _require_slope(subject, site, slopes[site], float(activations[site].float().norm()))


def _require_slope(subject: PolicySubject, site: Site, slope: Tensor, norm: float) -> None:
    """Check that along its own direction, in which it is steepest, a gradient is its norm."""
    steepness = float(slope.norm())
    require(steepness > 0, f"no gradient at {site}", "one: the acting part reads it")
    direction = slope / steepness
    differences: list[float] = []
    for step in STEPS:
        differences.append(_difference(subject, site, direction, step * norm))
        if len(differences) > 1 and abs(differences[-1] - differences[-2]) <= _AGREED * abs(differences[-1]):
            break
    jumps = [abs(after - before) for before, after in pairwise(differences)]
    best = differences[int(np.argmin(jumps)) + 1]
    require(
        abs(best / steepness - 1) <= CLOSE,
        f"at {site} a gradient of {steepness:.6g}",
        f"{best:.6g}, the difference",
    )


def _difference(subject: PolicySubject, site: Site, direction: Tensor, step: float) -> float:
    """Return the central difference (metric at + step − metric at − step) / (2 · step)."""
    values = []
    for sign in (1.0, -1.0):
        with edit(subject.policy, {site: partial(torch.add, sign * step * direction)}):
            values.append(float(_lateral(torch.from_numpy(subject.run(subject.single)).double())))
    return (values[0] - values[1]) / (2 * step)


def _lateral(actions: Tensor) -> Tensor:
    """Return the displacement in y, in metres, by the whole chunk of the first row."""
    return actions[0, :, 1].sum()


def _some_sites(policy: Policy) -> list[Site]:
    """Return a site in the backbone, the keys and values of the first block, and a site of the acting stream."""
    acting = [site for site in policy.sites() if policy.streams[site.stream].part == "action"]
    backbone = next(site for site in policy.sites() if policy.streams[site.stream].part == "backbone")
    kv = [] if policy.prompt_kv is None else [Site(policy.prompt_kv.name, 0, quantity) for quantity in KV]
    return [backbone, *kv, acting[len(acting) // 2]]


def _weights(policy: Policy) -> Sequence[Tensor]:
    network = getattr(policy, "network", None)
    return list(network.parameters()) if isinstance(network, torch.nn.Module) else []


def _differentiable(subject: PolicySubject) -> Policy:
    policy = subject.policy
    if not policy.interventions.gradients:
        with expect_refusal("differentiable actions", UnsupportedInterventionError, says=policy.card.family):
            policy.differentiable(subject.single, [0])
        raise SkipTest(f"{policy.card.family} declares no gradients, and refuses them by name")
    if policy.embodiment_mismatch() is not None:
        raise SkipTest(f"{policy.card.family} cannot act: its actions do not fit this arm")
    return policy
