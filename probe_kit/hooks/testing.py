"""The contract tests every adapter passes; subclass `AdapterContract` to test your own.

    @pytest.fixture(scope="module")
    def loaded():
        return load_my_family("tiny-checkpoint")


    class TestMyFamily(AdapterContract):
        @pytest.fixture
        def policy(self, loaded):
            return loaded

Needs pytest. `observations` may be overridden if your tokenizer does not know the default instructions.
"""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from probe_kit.errors import CaptureError, ObservationError, SiteNeverFiredError, UnknownSiteError
from probe_kit.hooks.capture_context import capture, edit
from probe_kit.hooks.model import Policy
from probe_kit.hooks.observation import Observation
from probe_kit.hooks.roles import Roles, pool
from probe_kit.hooks.sites import Site
from probe_kit.hooks.views import PADDING, view_names


def example_observations(instructions: Sequence[str]) -> list[Observation]:
    """One observation per instruction: noise pictures and plausible states, from a fixed seed."""
    rng = np.random.default_rng(0)
    return [
        Observation(
            rng.integers(0, 256, (48, 64, 3), dtype=np.uint8),
            np.array([0.3, 0.02 * index, 0.15, 0, 0, 0, 0, 1], np.float32),
            text,
        )
        for index, text in enumerate(instructions)
    ]


def _seeds(observations: Sequence[Observation], first: int = 0) -> list[int]:
    return list(range(first, first + len(observations)))


class AdapterContract:
    """What the rest of probe_kit relies on. Every test name is a promise."""

    tolerance = 1e-5
    """Of a batch against its rows one by one, float32."""

    @pytest.fixture
    def policy(self) -> Policy:
        """The adapter under test, loaded from a small checkpoint."""
        pytest.fail("override the fixture `policy` with your loaded adapter")

    @pytest.fixture
    def observations(self, policy: Policy) -> list[Observation]:
        """Two observations whose instructions differ in length, or one where the card's batch is one."""
        both = example_observations(["Put the cube on the star", "Put the cube on the red shape"])
        return both[: policy.card.batch]

    def test_sites_are_complete_ordered_and_without_doubles(self, policy: Policy) -> None:
        sites = policy.sites()
        assert len(set(sites)) == len(sites) > 0
        for stream in policy.streams.values():
            own = [site for site in sites if site.stream == stream.name]
            assert own == stream.sites()
            assert len(own) == stream.layers * (stream.iterations or 1)

    def test_every_site_fires_as_often_as_promised(self, policy: Policy, observations: list[Observation]) -> None:
        streams = (*policy.streams.values(), *policy.further_streams.values())
        for quantity in dict.fromkeys(kind for stream in streams for kind in stream.quantities):
            sites = [
                site for stream in streams if quantity in stream.quantities for site in stream.sites(quantity)
            ]
            with capture(policy, sites) as tape:
                policy.act(observations, _seeds(observations))
            assert len(tape) == len(sites)

    def test_activations_have_the_shape_of_their_stream(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        roles = policy.roles(observations)
        with capture(policy, policy.sites()) as tape:
            policy.act(observations, _seeds(observations))
        for name, stream in policy.streams.items():
            tokens = max(len(row) for row in roles[name])
            for site in stream.sites():
                assert tape[site].shape == (len(observations), tokens, stream.width)

    def test_capturing_changes_no_action_bit_for_bit(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        plain = policy.act(observations, _seeds(observations, 3))
        with capture(policy, policy.sites()):
            captured = policy.act(observations, _seeds(observations, 3))
        np.testing.assert_array_equal(plain, captured)

    def test_hooks_are_gone_after_an_exception(self, policy: Policy, observations: list[Observation]) -> None:
        plain = policy.act(observations, _seeds(observations))
        with pytest.raises(KeyError, match="body"), capture(policy, policy.sites()):
            raise KeyError("body")
        np.testing.assert_array_equal(plain, policy.act(observations, _seeds(observations)))
        with pytest.raises(SiteNeverFiredError), capture(policy, policy.sites()[:1]):
            pass

    def test_nested_captures_are_refused(self, policy: Policy, observations: list[Observation]) -> None:
        sites = policy.sites()[:1]
        with capture(policy, sites):
            with pytest.raises(CaptureError), capture(policy, sites):
                pass
            policy.act(observations, _seeds(observations))

    def test_actions_have_the_contracts_shape_and_come_from_the_seed_alone(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        torch.manual_seed(1)
        first = policy.act(observations, _seeds(observations, 5))
        torch.manual_seed(2)
        np.testing.assert_array_equal(first, policy.act(observations, _seeds(observations, 5)))
        assert first.shape == (len(observations), policy.card.chunk, 7)
        assert first.dtype == np.float32
        assert np.isfinite(first).all()

    def test_a_batch_equals_its_rows_one_by_one(self, policy: Policy, observations: list[Observation]) -> None:
        together = policy.act(observations, _seeds(observations, 7))
        for row, (observation, seed) in enumerate(zip(observations, _seeds(observations, 7), strict=True)):
            alone = policy.act([observation], [seed])[0]
            np.testing.assert_allclose(together[row], alone, atol=self.tolerance)

    def test_a_larger_batch_than_the_card_allows_is_refused(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        if policy.card.batch is not None:
            crowd = [observations[0]] * (policy.card.batch + 1)
            with pytest.raises(ObservationError, match="at most"):
                policy.act(crowd, _seeds(crowd))

    def test_every_observation_needs_its_seed(self, policy: Policy, observations: list[Observation]) -> None:
        with pytest.raises(ObservationError):
            policy.act(observations, _seeds(observations)[:-1])

    def test_roles_cover_every_position_and_are_the_declared_ones(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        for name, rows in policy.roles(observations).items():
            for row in rows:
                assert {span.role for span in row.spans} <= set(policy.role_names[name])
                assert row.valid.any()

    def test_padding_is_never_pooled(self, policy: Policy, observations: list[Observation]) -> None:
        for name, rows in policy.roles(observations).items():
            for row in rows:
                self._poison_padding(policy, name, row)

    def _poison_padding(self, policy: Policy, stream: str, roles: Roles) -> None:
        tokens = torch.ones(len(roles), 2)
        tokens[torch.from_numpy(roles.mask(PADDING))] = torch.nan
        views = view_names(policy.role_names[stream])
        assert torch.isfinite(pool(tokens.nan_to_num(1e9), roles, views)).all()
        assert pool(tokens.nan_to_num(1e9), roles, views).max() < 2

    def test_an_identity_edit_changes_nothing_and_zeroing_changes_the_action(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        plain = policy.act(observations, _seeds(observations))
        for stream in policy.streams.values():
            site = stream.sites()[1]
            with edit(policy, {site: lambda activation: activation}):
                same = policy.act(observations, _seeds(observations))
            np.testing.assert_array_equal(plain, same)
            with edit(policy, {site: torch.zeros_like}):
                changed = policy.act(observations, _seeds(observations))
            assert np.abs(changed - plain).max() > 0
        np.testing.assert_array_equal(plain, policy.act(observations, _seeds(observations)))

    def test_an_edit_is_what_a_capture_inside_it_reads(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        site = policy.sites()[1]
        with edit(policy, {site: torch.zeros_like}), capture(policy, [site]) as tape:
            policy.act(observations, _seeds(observations))
        assert (tape[site] == 0).all()

    def test_an_unknown_site_is_refused(self, policy: Policy) -> None:
        with pytest.raises(UnknownSiteError):
            policy.tap(Site("backbone", 999))

    def test_the_card_names_the_weights(self, policy: Policy) -> None:
        assert len(policy.card.weights_sha256) == 64
        assert policy.card.parameters > 0
        assert policy.card.cameras
