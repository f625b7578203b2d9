"""Contract tests of the interventions that `Policy.interventions` declares; part of `testing.AdapterContract`.

Properties that hold by construction, whatever the weights are. Needs pytest.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, get_args

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from probe_kit.errors import UnknownSiteError, UnsupportedInterventionError
from probe_kit.hooks.capturing.activation_cache import ActivationCache
from probe_kit.hooks.capturing.attention import capture_attention
from probe_kit.hooks.capturing.capture_context import capture, edit
from probe_kit.hooks.capturing.edit_engine import apply_edits
from probe_kit.hooks.capturing.edits import Edit, Vectors, vector_hash
from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.hooks.contract.model import Policy
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import KV, Site, Stream, kv_stream
from probe_kit.hooks.registry import find_family


class InterventionContract:
    """Every declared intervention runs and does what it says; every other one is refused by name."""

    family: ClassVar[str] = ""
    attention_tolerance: ClassVar[float] = 1e-4
    """By how much shares of attention may add up to more than 1: they are means of rounded numbers."""

    def test_policy_and_family_declare_the_same(self, policy: Policy) -> None:
        if self.family:
            assert find_family(self.family).interventions == policy.interventions
        assert policy.interventions.prompt_kv == (policy.prompt_kv is not None)
        assert set(policy.interventions.unread) <= policy.streams.keys()
        edits = policy.interventions.edits
        for name, stream in policy.streams.items():
            assert edits is None or set(edits[name]) == set(stream.quantities)

    def test_rewriting_every_site_with_itself_changes_no_action_bit_for_bit(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        sites = [
            site
            for stream in [*policy.streams.values(), *([] if policy.prompt_kv is None else [policy.prompt_kv])]
            for quantity in stream.quantities
            for site in stream.sites(quantity)
        ]
        seen = observations[:1]
        plain = policy.act(seen, [0])
        with edit(policy, {site: lambda activation: activation for site in sites}):
            same = policy.act(seen, [0])
        np.testing.assert_array_equal(plain, same)

    def test_what_is_rewritten_in_a_block_is_read_behind_it(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        seen = observations[:1]
        for stream in policy.streams.values():
            behind = [site for site in stream.sites() if site.layer == 1]
            plain = _captured(policy, seen, behind)
            for quantity in set(stream.quantities) - {"final_norm"}:
                written = [site for site in stream.sites(quantity) if site.layer == 0]
                with edit(policy, dict.fromkeys(written, torch.zeros_like)):
                    changed = _captured(policy, seen, behind)
                assert any((plain[site] != changed[site]).any() for site in behind), f"{stream.name}.{quantity}"

    def test_the_end_of_an_unread_stream_is_a_control(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        seen = observations[:1]
        plain = policy.act(seen, [0])
        for name in policy.interventions.unread:
            stream = policy.streams[name]
            for quantity in {"residual", "final_norm"} & set(stream.quantities):
                site = stream.sites(quantity)[-1]
                with edit(policy, {site: torch.zeros_like}):
                    np.testing.assert_array_equal(plain, policy.act(seen, [0]), err_msg=str(site))

    def test_what_is_not_supported_is_refused_by_name(self, policy: Policy) -> None:
        for kind in get_args(InterventionKind):
            if policy.interventions.supports(kind):
                policy.interventions.check(kind, policy.card.family)
                continue
            with pytest.raises(UnsupportedInterventionError, match=f"{policy.card.family}.*{kind}"):
                policy.interventions.check(kind, policy.card.family)
        if policy.prompt_kv is None:
            with pytest.raises(UnknownSiteError):
                policy.tap(kv_stream(1, 1).sites("keys")[0])

    # -- kv ------------------------------------------------------------------------------------------------

    def test_the_prompt_has_keys_and_values_for_every_token_of_the_backbone(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        kv, seen = self._prompt_kv(policy), observations[: policy.card.batch]
        sites = _all(kv)
        tape = _captured(policy, seen, sites)
        tokens = len(policy.token_roles(seen)[kv.name][0])
        assert len(tape) == len(sites) == 2 * (kv.layers - 1)
        for site in sites:
            assert tape[site].shape == (len(seen), tokens, kv.width)

    def test_all_keys_and_values_of_another_picture_give_that_pictures_actions(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        """State, words and noise are the same; bit for bit. What chose the first token goes along with it."""
        kv = self._prompt_kv(policy)
        one = observations[0]
        other = replace(one, image=255 - one.image)
        acting = [site for site in policy.sites() if policy.streams[site.stream].part == "action"]
        early = [site for site in acting if (site.iteration or 0) < policy.interventions.first_affected_token]
        late = [site for site in acting if site not in early]
        plain, source = (_captured(policy, [own], [*_all(kv), *acting]) for own in (one, other))
        edits, vectors = _edits_from(source, [*_all(kv), *early])
        with apply_edits(policy, edits, [one], vectors) as edit_log:
            edited = _captured(policy, [one], late)
        np.testing.assert_array_equal(policy.act([other], [0]), self._under(policy, edits, vectors, one))
        for site in late:
            torch.testing.assert_close(edited[site], source[site], rtol=0, atol=0)
        assert any((plain[site] != source[site]).any() for site in late)
        assert [entry.site for entry in edit_log.entries if entry.site.startswith(kv.name)] == [
            str(site) for layer in range(kv.layers - 1) for site in _of(kv, layer)
        ]
        assert sum(entry.moved for entry in edit_log.entries) > 0

    def test_values_of_one_role_are_replaced_in_that_role_only(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        kv = self._prompt_kv(policy)
        one = observations[0]
        site = _of(kv, 0)[1]
        plain, source = (
            _captured(policy, [own], [site])[site][0].float().cpu()
            for own in (one, replace(one, image=255 - one.image))
        )
        own = Edit("replace", (site,), roles=("image",), vector=vector_hash(source.numpy()))
        with apply_edits(policy, [own], [one], {own.vector: source.numpy()}) as edit_log:
            edited = _captured(policy, [one], [site])[site][0].float().cpu()
        image = torch.from_numpy(policy.token_roles([one])[kv.name][0].mask("image"))
        torch.testing.assert_close(edited, torch.where(image[:, None], source, plain), rtol=0, atol=0)
        assert [entry.tokens for entry in edit_log.entries] == [int(image.sum())]

    # -- tiles ---------------------------------------------------------------------------------------------

    def test_every_token_of_the_picture_comes_of_the_patches_that_are_named(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        """What leaves the vision tower at the patches of one token reaches that token's embedding and no other."""
        if not policy.interventions.tiles:
            with pytest.raises(UnknownSiteError, match=policy.card.family):
                policy.patch_order()
            return
        seen, order = observations[:1], policy.patch_order()
        stream = policy.every_stream()["vision"]
        last = next(site for site in stream.sites() if site.layer == stream.layers - 1)
        embedded = next(site for site in policy.sites() if policy.streams[site.stream].part == "backbone")
        picture = np.flatnonzero(policy.roles(seen)["backbone"][0].mask(f"image.{policy.card.cameras[0]}"))
        assert set(order) - {-1} == set(range(picture.size))
        plain = _captured(policy, seen, [last, embedded])
        assert plain[last].shape[-2] == order.size
        for token in (0, 1, picture.size // 2, picture.size - 1):
            own = torch.from_numpy(np.flatnonzero(order == token))

            def turned(passing: torch.Tensor, own: torch.Tensor = own) -> torch.Tensor:
                passing[:, own] = -passing[:, own]
                return passing

            with edit(policy, {last: turned}):
                changed = _captured(policy, seen, [embedded])
            moved = (changed[embedded] != plain[embedded])[0].any(dim=-1).cpu().numpy()
            assert np.flatnonzero(moved).tolist() == [picture[token]]

    # -- attention -----------------------------------------------------------------------------------------

    def test_attention_is_recorded_without_changing_an_action_bit_for_bit(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        if not policy.interventions.attention:
            with pytest.raises(UnsupportedInterventionError), capture_attention(policy):
                pass
            return
        seen = observations[: policy.card.batch]
        plain = policy.act(seen, range(len(seen)))
        with capture_attention(policy) as mass:
            recorded = policy.act(seen, range(len(seen)))
        np.testing.assert_array_equal(plain, recorded)
        backbone = next(own for own in policy.streams.values() if own.part == "backbone" and own.probed)
        roles = policy.roles(seen)[backbone.name]
        valid = np.stack([row.valid for row in roles])
        steps = max(own.iterations or 1 for own in policy.streams.values() if own.part == "action")
        assert {iteration for _, iteration in mass.by_read} >= set(range(steps))
        assert {block for block, _ in mass.by_read} <= set(range(backbone.layers - 1))
        for weights, whole in zip(mass.by_read.values(), mass.on(valid).values(), strict=True):
            assert weights.shape == valid.shape
            assert (weights >= 0).all()
            assert ((whole > 0) & (whole <= 1 + self.attention_tolerance)).all()
            assert np.abs(weights[~valid]).max(initial=0) == 0
        assert all((share > 0).all() for share in mass.of_role(roles, "image").values())

    def _prompt_kv(self, policy: Policy) -> Stream:
        if policy.prompt_kv is None:
            pytest.skip(f"{policy.card.family} declares no kv stream")
        return policy.prompt_kv

    @staticmethod
    def _under(policy: Policy, edits: list[Edit], vectors: Vectors, seen: Observation) -> NDArray[np.float32]:
        with apply_edits(policy, edits, [seen], vectors):
            return policy.act([seen], [0])


def _captured(policy: Policy, seen: Sequence[Observation], sites: Sequence[Site]) -> ActivationCache:
    """What one inference leaves at `sites`."""
    with capture(policy, sites) as tape:
        policy.act(seen, range(len(seen)))
    return tape


def _of(kv: Stream, layer: int) -> list[Site]:
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
