"""Contract tests of adapters; subclass `AdapterContract` (policies) or `AnswerModelContract` (answering models).

    class TestMyFamily(AdapterContract):
        family = "my-family"

        @pytest.fixture(scope="class")
        def checkpoint(self, tmp_path_factory):
            return write_tiny_checkpoint(tmp_path_factory.mktemp("mine"))

        @pytest.fixture
        def other_options(self):
            return {"crop": True}  # another value for each declared option

Needs pytest. Override `observations` and `alike` if your tokenizer does not know the default instructions, and
`policy` if loading takes more than the checkpoint.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file

from probe_kit.errors import (
    CaptureError,
    CheckpointError,
    ObservationError,
    SiteNeverFiredError,
    UnknownSiteError,
    UsageError,
    WeightsError,
)
from probe_kit.hooks.capturing.capture_context import capture, edit
from probe_kit.hooks.contract.model import AnswerModel, Model, Policy, Prompt, Reading
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles, pool
from probe_kit.hooks.contract.sites import PARTS, Site, Stream
from probe_kit.hooks.contract.views import PADDING, plays, view_names
from probe_kit.hooks.family import SIZE, Family
from probe_kit.hooks.intervention_contract import InterventionContract
from probe_kit.hooks.registry import find_family

_SUM = ("residual", "attention", "mlp")


def example_observations(instructions: Sequence[str], cameras: Sequence[str] = ()) -> list[Observation]:
    """One observation per instruction: noise pictures, plausible states and intrinsics, from a fixed seed."""
    rng = np.random.default_rng(0)
    size = (48, 64, 3)
    intrinsics = np.array([[60, 0, 32], [0, 60, 24], [0, 0, 1]], np.float32)
    return [
        Observation(
            rng.integers(0, 256, size, dtype=np.uint8),
            np.array([0.3, 0.02 * index, 0.15, 0, 0, 0, 0, 1], np.float32),
            text,
            intrinsics,
            {camera: rng.integers(0, 256, size, dtype=np.uint8) for camera in cameras},
        )
        for index, text in enumerate(instructions)
    ]


class ModelContract:
    """What capture, edits, verification and the store rely on. Every test name is a promise."""

    family: ClassVar[str] = ""
    """Name under which the registry loads `checkpoint`; empty to leave out the tests of loading."""
    unloadable_options: ClassVar[frozenset[str]] = frozenset()
    """Options that this machine cannot try, such as quantisation without a GPU."""
    options: ClassVar[Mapping[str, Any]] = {}
    """What `checkpoint` needs to load."""
    configuration: ClassVar[str] = "config.json"
    """A file of the checkpoint that the loader reads."""
    tolerance: ClassVar[float] = 1e-5
    """Of a batch against its rows one by one, and of sums against the stream, float32."""

    @pytest.fixture(scope="class")
    def checkpoint(self) -> Path:
        """The tiny checkpoint the model is loaded from, in the released layout."""
        pytest.skip("no checkpoint was named; override the fixture `checkpoint`")

    @pytest.fixture
    def other_options(self) -> Mapping[str, Any]:
        """For every declared option a value other than the default."""
        return {}

    @pytest.fixture
    def observations(self, model: Model) -> list[Observation]:
        """Two observations whose instructions differ in length."""
        return self.examples(model, "Put the cube on the star", "Put the cube on the red shape")

    @pytest.fixture
    def alike(self, model: Model) -> list[Observation]:
        """Two observations whose instructions differ, but not in their number of tokens."""
        return self.examples(model, "Put the cube on the star", "Put the cube on the cube")

    @staticmethod
    def examples(model: Model, *instructions: str) -> list[Observation]:
        """Observations that hold what the model needs."""
        cameras = [need.removeprefix("camera.") for need in sorted(model.card.needs) if need.startswith("camera.")]
        return example_observations(instructions, cameras)

    def run(self, model: Model, seen: Sequence[Observation]) -> NDArray[np.float32]:
        """One inference: a row of numbers per observation."""
        raise NotImplementedError

    def load(self, checkpoint: Path, **options: Any) -> Model:
        """The model as users load it."""
        return self._family.load(str(checkpoint), options={**self.options, **options})

    @property
    def _family(self) -> Family:
        if not self.family:
            pytest.skip("no family was named; set `family`")
        return find_family(self.family)

    @staticmethod
    def shown(model: Model, observations: list[Observation]) -> list[Observation]:
        """As many observations as one call takes."""
        return observations[: model.card.batch]

    # -- sites and capture -------------------------------------------------------------------------------

    def test_streams_declare_what_they_are(self, model: Model) -> None:
        for name, stream in model.every_stream().items():
            assert stream.name == name
            assert stream.part in PARTS
            assert stream.label
            assert "residual" in stream.quantities or stream is model.prompt_kv
        parts = [stream.part for stream in model.streams.values() if stream.probed]
        assert "backbone" in parts

    def test_sites_are_complete_ordered_and_without_doubles(self, model: Model) -> None:
        sites = model.sites()
        assert len(set(sites)) == len(sites) > 0
        for stream in model.streams.values():
            own = [site for site in sites if site.stream == stream.name]
            assert own == stream.sites()
            assert len(own) == stream.layers * (stream.iterations or 1)

    def test_every_site_of_every_quantity_fires_as_often_as_promised(
        self, model: Model, observations: list[Observation]
    ) -> None:
        for stream in model.every_stream().values():
            for quantity in stream.quantities:
                sites = stream.sites(quantity)
                with capture(model, sites) as tape:
                    self.run(model, self.shown(model, observations))
                assert len(tape) == len(sites)

    def test_activations_have_the_shape_of_their_stream(
        self, model: Model, observations: list[Observation]
    ) -> None:
        seen = self.shown(model, observations)
        roles = self.roles_of(model, seen)
        with capture(model, model.sites()) as tape:
            self.run(model, seen)
        assert roles.keys() == model.streams.keys()
        for name, stream in model.streams.items():
            tokens = {len(row) for row in roles[name]}
            assert len(tokens) == 1
            for site in stream.sites():
                assert tape[site].shape == (len(seen), *tokens, stream.width)

    def test_what_blocks_add_makes_the_next_residual(self, model: Model, observations: list[Observation]) -> None:
        """residual(l) + attention(l) + mlp(l) = residual(l + 1), where a stream declares all three."""
        seen = self.shown(model, observations)
        roles = self.roles_of(model, seen)
        for name, stream in model.streams.items():
            if not (stream.sums and set(_SUM) <= set(stream.quantities)):
                continue
            with capture(model, [site for quantity in _SUM for site in stream.sites(quantity)]) as tape:
                self.run(model, seen)
            valid = torch.from_numpy(np.stack([row.valid for row in roles[name]]))
            for site in stream.sites("attention"):
                parts = [tape[replace(site, quantity=quantity)].double().cpu() for quantity in _SUM]
                following = tape[replace(site, layer=site.layer + 1, quantity="residual")].double().cpu()
                difference = (sum(parts) - following)[valid]
                assert difference.abs().max() <= self.tolerance * (1 + following[valid].abs().max()), str(site)

    def test_capturing_changes_no_output_bit_for_bit(self, model: Model, observations: list[Observation]) -> None:
        seen = self.shown(model, observations)
        plain = self.run(model, seen)
        with capture(model, model.sites()):
            captured = self.run(model, seen)
        np.testing.assert_array_equal(plain, captured)

    def test_hooks_are_gone_after_an_exception(self, model: Model, observations: list[Observation]) -> None:
        seen = self.shown(model, observations)
        plain = self.run(model, seen)
        with pytest.raises(KeyError, match="body"), capture(model, model.sites()):
            raise KeyError("body")
        np.testing.assert_array_equal(plain, self.run(model, seen))
        with pytest.raises(SiteNeverFiredError), capture(model, model.sites()[:1]):
            pass

    def test_nested_captures_are_refused(self, model: Model, observations: list[Observation]) -> None:
        sites = model.sites()[:1]
        with capture(model, sites):
            with pytest.raises(CaptureError), capture(model, sites):
                pass
            self.run(model, self.shown(model, observations))

    def test_an_unknown_site_is_refused(self, model: Model) -> None:
        stream = next(iter(model.streams))
        for site in (Site(stream, 999), Site(stream, 0, "nonsense"), Site("nowhere", 0)):
            with pytest.raises(UnknownSiteError):
                model.tap(site)

    # -- edits -------------------------------------------------------------------------------------------

    def test_an_identity_edit_changes_nothing_and_zeroing_changes_the_output(
        self, model: Model, observations: list[Observation]
    ) -> None:
        seen = self.shown(model, observations)
        plain = self.run(model, seen)
        for stream in model.streams.values():
            if not stream.probed:
                continue
            site = stream.sites()[1]
            with edit(model, {site: lambda activation: activation}):
                same = self.run(model, seen)
            np.testing.assert_array_equal(plain, same)
            with edit(model, dict.fromkeys(self._everywhere(stream, site), torch.zeros_like)):
                changed = self.run(model, seen)
            assert np.abs(changed - plain).max() > 0, str(site)
        np.testing.assert_array_equal(plain, self.run(model, seen))

    @staticmethod
    def _everywhere(stream: Stream, site: Site) -> list[Site]:
        """The site at every iteration: one action token of several may decide nothing that is printed."""
        return [own for own in stream.sites() if own.layer == site.layer]

    def test_an_edit_is_what_a_capture_inside_it_reads(
        self, model: Model, observations: list[Observation]
    ) -> None:
        site = model.sites()[1]
        with edit(model, {site: torch.zeros_like}), capture(model, [site]) as tape:
            self.run(model, self.shown(model, observations))
        assert (tape[site] == 0).all()

    # -- rows --------------------------------------------------------------------------------------------

    def test_a_batch_equals_its_rows_one_by_one(self, model: Model, observations: list[Observation]) -> None:
        if model.card.batch == 1:
            with pytest.raises(ObservationError, match="at most 1"):
                self.run(model, observations)
            return
        together = self.run(model, observations)
        for row, observation in enumerate(observations):
            alone = self.run_row(model, observation, row)
            np.testing.assert_allclose(together[row], alone, atol=self.tolerance)

    def roles_of(self, model: Model, seen: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Roles of what `run` makes of these observations."""
        return model.roles(seen)

    def run_row(self, model: Model, observation: Observation, row: int) -> NDArray[np.float32]:
        """What `run` gives for row `row` of a batch, alone."""
        del row
        return np.asarray(self.run(model, [observation])[0])

    def test_an_observation_without_what_is_needed_is_refused(
        self, model: Model, observations: list[Observation]
    ) -> None:
        bare = replace(observations[0], intrinsics=None, cameras={})
        if not model.card.needs - {"state"}:
            self.run(model, [bare])
            return
        with pytest.raises(ObservationError, match="reads"):
            self.run(model, [bare])

    # -- roles -------------------------------------------------------------------------------------------

    def test_roles_cover_every_position_and_are_the_declared_ones(
        self, model: Model, observations: list[Observation]
    ) -> None:
        for name, rows in self.roles_of(model, self.shown(model, observations)).items():
            for row in rows:
                assert {span.role for span in row.spans} <= set(model.role_names[name])
                assert row.valid.any()

    def test_another_picture_moves_image_positions_only(
        self, model: Model, observations: list[Observation]
    ) -> None:
        """At the embeddings, so that roles are compared with the model and not with themselves."""
        one = observations[0]
        self._assert_moves(model, one, replace(one, image=255 - one.image), "image")

    def test_another_instruction_moves_language_positions_only(
        self, model: Model, alike: list[Observation]
    ) -> None:
        one = alike[0]
        self._assert_moves(model, one, replace(one, instruction=alike[1].instruction), "language")

    def _assert_moves(self, model: Model, one: Observation, other: Observation, role: str) -> None:
        stream = next(own for own in model.streams.values() if own.part == "backbone" and own.probed)
        before, after = (self.roles_of(model, [own])[stream.name][0] for own in (one, other))
        assert before == after, "override `alike` with instructions of equally many tokens"
        site, kept = stream.sites()[0], []
        for observation in (one, other):
            with capture(model, [site]) as tape:
                self.run(model, [observation])
            kept.append(tape[site][0].float().cpu())
        moved = (kept[0] != kept[1]).any(dim=1).numpy() & before.valid
        assert moved.any(), f"another {role} moved nothing"
        labels = {name for span in before.spans for name in [span.role] if moved[span.start : span.stop].any()}
        assert all(plays(name, role) for name in labels), f"another {role} moved {sorted(labels)}"

    def test_padding_is_never_pooled(self, model: Model, observations: list[Observation]) -> None:
        for name, rows in self.roles_of(model, self.shown(model, observations)).items():
            for row in rows:
                self._poison_padding(model, name, row)

    def _poison_padding(self, model: Model, stream: str, roles: Roles) -> None:
        tokens = torch.ones(len(roles), 2)
        tokens[torch.from_numpy(roles.mask(PADDING))] = torch.nan
        present = {span.role for span in roles.spans}
        views = view_names([role for role in model.role_names[stream] if role in present])
        assert torch.isfinite(pool(tokens.nan_to_num(1e9), roles, views)).all()
        assert pool(tokens.nan_to_num(1e9), roles, views).max() < 2

    # -- the card and loading ----------------------------------------------------------------------------

    def test_the_card_names_the_weights(self, model: Model) -> None:
        assert len(model.card.weights_sha256) == 64
        assert model.card.parameters > 0
        assert model.card.cameras
        assert all(isinstance(value, str) for value in model.card.settings.values())

    def test_every_file_that_is_read_reaches_the_card(self, checkpoint: Path, tmp_path: Path) -> None:
        """By content: a space at the end of a configuration makes another identity."""
        copied = Path(shutil.copytree(checkpoint, tmp_path / "copy"))
        before = self.load(copied).card
        configuration = copied / self.configuration
        configuration.write_text(configuration.read_text(encoding="utf-8") + " ", encoding="utf-8")
        after = self.load(copied).card
        assert before.weights_sha256 == after.weights_sha256
        assert before.settings != after.settings

    def test_every_option_reaches_the_card(self, checkpoint: Path, other_options: Mapping[str, Any]) -> None:
        declared = {option.name for option in self._family.options} - self.unloadable_options - {SIZE}
        assert declared <= other_options.keys(), "name another value of every option in `other_options`"
        plain = self.load(checkpoint).card.settings
        for name in sorted(declared):
            assert self.load(checkpoint, **{name: other_options[name]}).card.settings != plain, name

    def test_an_option_that_is_not_declared_is_refused(self, checkpoint: Path) -> None:
        with pytest.raises(UsageError, match="no model option nonsense"):
            self.load(checkpoint, nonsense=1)

    def test_random_twins_differ_by_their_seed_and_repeat_by_it(self, checkpoint: Path) -> None:
        twins = [
            self._family.load(str(checkpoint), random_weights=True, weights_seed=seed, options=self.options).card
            for seed in (1, 1, 2)
        ]
        assert twins[0].weights_sha256 == twins[1].weights_sha256 != twins[2].weights_sha256
        assert [twin.weights_seed for twin in twins] == [1, 1, 2]
        assert all(twin.random_weights for twin in twins)

    @pytest.mark.parametrize("damage", ["missing", "extra", "shape", "nan"])
    def test_weights_that_are_not_exactly_the_models_are_refused(
        self, checkpoint: Path, tmp_path: Path, damage: str
    ) -> None:
        copied = Path(shutil.copytree(checkpoint, tmp_path / "copy"))
        _damage(copied, damage)
        with pytest.raises((WeightsError, CheckpointError)):
            self.load(copied)


def _damage(folder: Path, damage: str) -> None:
    """Change one tensor of the last safetensors file of weights."""
    files = sorted(folder.glob("model*.safetensors"))
    if not files:
        pytest.skip(f"{folder} holds no safetensors to damage")
    tensors = load_file(files[-1])
    name = next(name for name in sorted(tensors) if ".layers." in name or ".blocks." in name)
    original = tensors[name]
    if damage == "missing":
        del tensors[name]
    elif damage == "extra":
        tensors["not.in.the.network.weight"] = torch.ones(2)
    elif damage == "shape":
        tensors[name] = torch.cat([original, original])
    else:
        tensors[name] = torch.full_like(original, torch.nan)
    save_file(tensors, files[-1])


class AdapterContract(InterventionContract, ModelContract):
    """What the rest of probe_kit relies on in a `Policy`."""

    @pytest.fixture
    def policy(self, checkpoint: Path) -> Policy:
        """The adapter under test; override it to load it once per module."""
        model = self.load(checkpoint)
        assert isinstance(model, Policy)
        return model

    @pytest.fixture
    def model(self, policy: Policy) -> Policy:
        """The same, as the tests of every model know it."""
        return policy

    def run(self, model: Model, seen: Sequence[Observation]) -> NDArray[np.float32]:
        """Actions from the seeds 0, 1 …"""
        assert isinstance(model, Policy)
        return model.act(seen, range(len(seen)))

    def run_row(self, model: Model, observation: Observation, row: int) -> NDArray[np.float32]:
        """With the row's own seed."""
        assert isinstance(model, Policy)
        return np.asarray(model.act([observation], [row])[0])

    def test_the_action_is_made_in_a_stream(self, policy: Policy) -> None:
        assert any(stream.part == "action" and stream.probed for stream in policy.streams.values())
        assert policy.card.chunk >= policy.card.execute >= 1

    def test_actions_have_the_contracts_shape_and_come_from_the_seed_alone(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        seen = self.shown(policy, observations)
        seeds = [5, 6][: len(seen)]
        torch.manual_seed(1)
        first = policy.act(seen, seeds)
        torch.manual_seed(2)
        np.testing.assert_array_equal(first, policy.act(seen, seeds))
        assert first.shape == (len(seen), policy.card.chunk, 7)
        assert first.dtype == np.float32
        assert np.isfinite(first).all()

    def test_inference_without_acting_equals_that_of_acting(
        self, policy: Policy, observations: list[Observation]
    ) -> None:
        """Capture changes no action bit at any site, and the actions fit the arm."""
        assert policy.embodiment_mismatch() is None
        seen = self.shown(policy, observations)[:1]
        sites = policy.sites()
        with capture(policy, sites) as acting:
            policy.act(seen, [5])
        with capture(policy, sites) as without_acting:
            raw = policy.infer_without_acting(seen, [5])
        assert raw.shape[0] == 1
        for site in sites:
            torch.testing.assert_close(acting[site], without_acting[site], rtol=0, atol=0)

    def test_every_observation_needs_its_seed(self, policy: Policy, observations: list[Observation]) -> None:
        with pytest.raises(ObservationError):
            policy.act(self.shown(policy, observations), [])


class AnswerModelContract(ModelContract):
    """What the rest of probe_kit relies on in an `AnswerModel`."""

    letters: ClassVar[tuple[str, ...]] = ("A", "B")
    other_words: ClassVar[str] = " please"
    """What makes a question longer, in words that the tokenizer knows."""

    @pytest.fixture
    def answer_model(self, checkpoint: Path) -> AnswerModel:
        """The adapter under test; override it to load it once per module."""
        model = self.load(checkpoint)
        assert isinstance(model, AnswerModel)
        return model

    @pytest.fixture
    def model(self, answer_model: AnswerModel) -> AnswerModel:
        """The same, as the tests of every model know it."""
        return answer_model

    def questions(self, seen: Sequence[Observation]) -> list[Prompt]:
        """The observations' instructions as questions."""
        return [Prompt(own, own.instruction, self.letters) for own in seen]

    def led(self, answer_model: AnswerModel, questions: Sequence[Prompt]) -> list[Prompt]:
        """With options as they stand behind the frame."""
        return [
            own if own.begun else replace(own, options=tuple(answer_model.lead + letter for letter in own.options))
            for own in questions
        ]

    def run(self, model: Model, seen: Sequence[Observation]) -> NDArray[np.float32]:
        """The logits of the options."""
        return self._read(model, seen).option_logits

    def roles_of(self, model: Model, seen: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Of the questions asked about them."""
        assert isinstance(model, AnswerModel)
        return model.asked_roles(self.led(model, self.questions(seen)))

    def _read(self, model: Model, seen: Sequence[Observation]) -> Reading:
        assert isinstance(model, AnswerModel)
        return model.read(self.led(model, self.questions(seen)))

    def _ask(self, answer_model: AnswerModel, questions: Sequence[Prompt]) -> NDArray[np.float32]:
        return answer_model.read(self.led(answer_model, questions)).option_logits

    def test_a_reading_has_a_logit_per_option_and_their_mass_is_a_share(
        self, answer_model: AnswerModel, observations: list[Observation]
    ) -> None:
        seen = self.shown(answer_model, observations)
        reading = self._read(answer_model, seen)
        assert reading.option_logits.shape == (len(seen), len(self.letters))
        assert reading.option_mass.shape == (len(seen),)
        assert ((reading.option_mass > 0) & (reading.option_mass <= 1)).all()

    def test_what_is_spoken_repeats_and_is_as_long_as_asked(
        self, answer_model: AnswerModel, observations: list[Observation]
    ) -> None:
        seen = self.shown(answer_model, observations)
        first = answer_model.speak(self._read(answer_model, seen), 4)
        assert first == answer_model.speak(self._read(answer_model, seen), 4)
        assert len(first) == len(seen)
        assert all(isinstance(text, str) for text in first)

    def test_speaking_does_not_use_a_reading_up(
        self, answer_model: AnswerModel, observations: list[Observation]
    ) -> None:
        reading = self._read(answer_model, self.shown(answer_model, observations))
        assert answer_model.speak(reading, 4) == answer_model.speak(reading, 4)
        assert answer_model.speak(reading, 0) == [""] * len(reading.option_logits)

    def test_rows_in_another_order_are_answered_alike(
        self, answer_model: AnswerModel, observations: list[Observation]
    ) -> None:
        if answer_model.card.batch == 1:
            pytest.skip(f"{answer_model.card.family} reads one question at a time")
        questions = self.questions(observations)
        forth, back = self._ask(answer_model, questions), self._ask(answer_model, questions[::-1])
        np.testing.assert_allclose(forth, back[::-1], atol=self.tolerance)

    def test_a_far_longer_neighbour_changes_nothing(
        self, answer_model: AnswerModel, observations: list[Observation]
    ) -> None:
        if answer_model.card.batch == 1:
            pytest.skip(f"{answer_model.card.family} reads one question at a time")
        short = self.questions(observations)[0]
        longer = replace(short, text=short.text + self.other_words * 6)
        together, alone = self._ask(answer_model, [short, longer]), self._ask(answer_model, [short])
        np.testing.assert_allclose(together[0], alone[0], atol=self.tolerance)
        spoken = [
            answer_model.speak(answer_model.read(self.led(answer_model, asked)), 4)[0]
            for asked in ([short, longer], [short])
        ]
        assert spoken[0] == spoken[1]

    def test_without_a_picture_nothing_of_it_is_left(
        self, answer_model: AnswerModel, observations: list[Observation]
    ) -> None:
        """Also right behind questions about pictures: no state may stay from call to call."""
        asked = [replace(own, pictured=False) for own in self.questions(self.shown(answer_model, observations))]
        other = [replace(own, seen=replace(own.seen, image=255 - own.seen.image)) for own in asked]
        before = self._ask(answer_model, asked)
        self._read(answer_model, self.shown(answer_model, observations))
        np.testing.assert_array_equal(before, self._ask(answer_model, other))
        for rows in answer_model.asked_roles(self.led(answer_model, asked)).values():
            assert not any(row.mask("image").any() for row in rows)

    def test_questions_with_and_without_a_picture_do_not_go_together(
        self, answer_model: AnswerModel, observations: list[Observation]
    ) -> None:
        first, second = self.questions(observations)
        with pytest.raises((UsageError, ObservationError)):
            self._ask(answer_model, [first, replace(second, pictured=False)])

    def test_options_that_begin_alike_are_refused(
        self, answer_model: AnswerModel, observations: list[Observation]
    ) -> None:
        twice = replace(self.questions(observations)[0], options=(self.letters[0], self.letters[0]))
        with pytest.raises(UsageError, match="same token"):
            self._ask(answer_model, [twice])

    def test_a_choice_that_rounding_decides_is_a_near_tie(
        self, answer_model: AnswerModel, observations: list[Observation]
    ) -> None:
        reading = self._read(answer_model, self.shown(answer_model, observations))
        rows = len(reading.option_logits)
        apart = np.tile(np.array([[0.0, 9.0]], np.float32), (rows, 1))
        assert not answer_model.near_ties(replace(reading, option_logits=apart)).any()
        assert answer_model.near_ties(replace(reading, option_logits=apart * 1e-6)).all()
