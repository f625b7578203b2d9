"""Whatever an adapter does in a check becomes one outcome in words; Ctrl-C ends the command."""

import ast
import dataclasses
import os
import re
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from torch import Tensor

import probe_kit
from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks import Family, Model, Observation, Roles, Site, Stream, Tap, registry
from probe_kit.hooks.checkpoints.weights import read_weights
from probe_kit.hooks.conformance.check import (
    CheckFailedError,
    CheckOutcome,
    SkipTest,
    check,
    expect_refusal,
    package_of,
    place_of,
    require_bits,
    try_check,
)
from probe_kit.hooks.conformance.subject import AnswerSubject, PolicySubject, Subject
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.hooks.family_parts import Requirements
from probe_kit.hooks.testing import ANSWER_CHECKS, POLICY_CHECKS
from tests.support.contracts import GOLDEN
from tests.support.encoder_vla.policy import CHUNK, STEPS, WIDTH, EncoderPolicy, EncoderVLA, load, write_checkpoint
from tests.support.parsed import package_nodes
from tests.support.position_models import PositionModel, always, likes


def of(error: BaseException | None) -> CheckOutcome:
    def body() -> None:
        if error is not None:
            raise error

    return try_check("name", "A promise.", "Do it.", body, "tests.hooks")


def test_no_error_is_passed_and_a_skip_has_its_reason() -> None:
    assert of(None) == CheckOutcome("name", "passed", "A promise.")
    assert of(SkipTest("no kv")) == CheckOutcome("name", "skipped", "A promise.", reason="no kv")


def test_a_failure_has_what_was_seen_expected_and_to_be_changed() -> None:
    assert of(CheckFailedError("this", "that")) == CheckOutcome(
        "name", "failed", "A promise.", "this", "that", "Do it."
    )
    assert of(CheckFailedError("this", "that", "Do that.")).change == "Do that."


@pytest.mark.parametrize("error", [ValueError("odd"), SystemExit(3), KeyboardInterrupt("mine"), MemoryError()])
def test_whatever_an_adapter_raises_is_a_failure_that_names_its_line(error: BaseException) -> None:
    outcome = of(error)
    assert (outcome.state, outcome.change) == ("failed", "Do it.")
    assert "sys.exit(3)" in outcome.actual or type(error).__name__ in outcome.actual
    assert f"{Path(__file__).name}:" in outcome.actual


def test_an_error_of_ours_is_told_whole_with_its_notes() -> None:
    error = CheckpointError("the file is torn")
    error.add_note("part 2 of 3")
    assert of(error).actual.startswith("CheckpointError: the file is torn; part 2 of 3 (")


def test_what_a_loader_raised_is_told_in_place_of_the_advice_to_download_again() -> None:
    error = CheckpointError("cannot be loaded; download it again")
    try:
        raise ValueError("width 3")
    except ValueError as cause:
        error.__cause__ = cause
    assert of(error).actual.startswith("ValueError: width 3 (")


def test_ctrl_c_ends_the_command() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    try:
        with pytest.raises(KeyboardInterrupt):
            try_check("name", "A promise.", "Do it.", lambda: os.kill(os.getpid(), signal.SIGINT), "tests")
    finally:
        signal.signal(signal.SIGINT, before)


def test_what_an_adapter_changed_in_the_process_is_put_back() -> None:
    folder = Path.cwd()
    try_check("name", "A promise.", "Do it.", lambda: os.chdir("/"), "tests")
    assert Path.cwd() == folder


def test_the_place_is_that_of_the_adapters_own_code() -> None:
    assert package_of("my_vla.loading:load") == "my_vla"
    assert package_of("my_adapter:load") == "my_adapter"
    assert package_of("probe_kit.hooks.families.pi0.adapter:load") == "probe_kit.hooks.families.pi0"
    with pytest.raises(ValueError, match="x") as raised:
        int("x")
    assert place_of(raised.value, "somewhere.else") == ""
    assert f"{Path(__file__).name}:" in place_of(raised.value, __name__)


CHECKS = {each_check.name: each_check for each_check in (*POLICY_CHECKS, *ANSWER_CHECKS)}


@pytest.fixture(autouse=True)
def unfused() -> Iterator[None]:
    before = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    yield
    torch.backends.mha.set_fastpath_enabled(before)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("encoder") / "checkpoint")


@pytest.fixture(scope="module")
def sound(checkpoint: Path) -> EncoderPolicy:
    return load(str(checkpoint))


def policy_subject(model: Model, checkpoint: Path | str = "") -> PolicySubject:
    return PolicySubject(checkpoint=checkpoint, model=model)


# -- policies --------------------------------------------------------------------------------------------------


class Longer(EncoderPolicy):
    streams = EncoderPolicy.streams | {"expert": Stream("expert", 3, WIDTH, STEPS + 1)}


class Narrower(EncoderPolicy):
    streams = EncoderPolicy.streams | {"backbone": Stream("backbone", 3, WIDTH - 1)}


class Nameless(EncoderPolicy):
    streams = EncoderPolicy.streams | {"expert": Stream("other", 3, WIDTH, STEPS, part="action")}


class Turned(EncoderPolicy):
    """Calls the picture words, and the words picture."""

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        roles, other = super().roles(observations), {"image.primary": "language", "language": "image.primary"}
        turned = [Roles(tuple(span._replace(role=other.get(span.role, span.role)) for span in row.spans))
                  for row in roles["backbone"]]  # fmt: skip
        return {**roles, "backbone": turned}


class Misnamed(EncoderPolicy):
    role_names = EncoderPolicy.role_names | {"backbone": ("image.primary", "padding")}


class Elsewhere(EncoderPolicy):
    """The MLP tapped in front of its last step."""

    def tap(self, site: Site) -> Tap:
        tap = super().tap(site)
        return dataclasses.replace(tap, module=self.network.get_submodule(
            f"{site.stream}.layers.{site.layer}.norm2")) if site.quantity == "mlp" else tap  # fmt: skip


class Unchecked(EncoderPolicy):
    """Takes any site and any number of seeds."""

    def tap(self, site: Site) -> Tap:
        del site
        return Tap(self.network.velocity, 1)

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        return super().act(observations, [*seeds, *range(len(observations))][: len(observations)])


class Copying(EncoderPolicy):
    """Hands out copies, into which an edit writes in vain."""

    def tap(self, site: Site) -> Tap:
        return dataclasses.replace(super().tap(site), view=Tensor.clone)


class Drifting(EncoderPolicy):
    calls = count(1)

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        return super().act(observations, seeds) + np.float32(1e-3 * next(self.calls))


class Drawing(EncoderPolicy):
    """Noise from the global generator."""

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        return super().act(observations, torch.randint(2**31, (len(seeds),)).tolist())


class Constant(EncoderPolicy):
    """One noise for every seed."""

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        return super().act(observations, [0] * len(seeds))


class Seedless(EncoderPolicy):
    """Declares that no noise is drawn."""

    draws_noise = False


class Doubling(EncoderPolicy):
    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        return super().act(observations, seeds).astype(np.float64)  # type: ignore[return-value]


class Mixing(EncoderPolicy):
    """Rows that know of each other."""

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        actions = super().act(observations, seeds)
        return np.asarray(actions + actions.mean(axis=0), np.float32)


class Boasting(EncoderPolicy):
    """Declares what it has not."""

    interventions = dataclasses.replace(EncoderPolicy.interventions, unread=("expert",))


class Passive(EncoderPolicy):
    streams = EncoderPolicy.streams | {"expert": Stream("expert", 3, WIDTH, STEPS, part="bridge")}


class Otherwise(EncoderPolicy):
    def infer_without_acting(
        self, observations: Sequence[Observation], seeds: Sequence[int]
    ) -> NDArray[np.float32]:
        return self.act(observations, [seed + 1 for seed in seeds])


@pytest.mark.parametrize(
    ("broken", "name", "reason"),
    [
        (Longer, "every_site_of_every_quantity_fires_as_often_as_promised", "expert"),
        (Narrower, "activations_have_the_shape_of_their_stream", "has the shape"),
        (Nameless, "streams_declare_what_they_are", "the stream 'other' under the key 'expert'"),
        (Turned, "another_picture_moves_image_positions_only", "another image changes positions with the roles"),
        (Turned, "another_instruction_moves_language_positions_only", "another language"),
        (Misnamed, "roles_cover_every_position_and_are_the_declared_ones", "language"),
        (Elsewhere, "what_blocks_add_makes_the_next_residual", "the sum is off by"),
        (Unchecked, "an_unknown_site_is_refused", "tap(backbone.999.residual): no error"),
        (Unchecked, "every_observation_needs_its_seed", "an observation without a seed: no error"),
        (Copying, "an_identity_edit_changes_nothing_and_zeroing_changes_the_output", "change no output"),
        (Copying, "an_edit_is_what_a_capture_inside_it_reads", "behind an edit to zeros"),
        (Copying, "what_is_rewritten_in_a_block_is_read_behind_it", "leave layer 1 as it was"),
        (Drifting, "capturing_changes_no_output_bit_for_bit", "keeps state between calls"),
        (Drifting, "hooks_are_gone_after_an_exception", "outputs after the exception differ"),
        (
            Drawing,
            "actions_have_the_contracts_shape_and_come_from_the_seed_alone",
            "actions of the same seeds differ",
        ),
        (Constant, "another_seed_gives_another_chunk_where_noise_is_drawn", "the same actions of two seeds"),
        (Seedless, "another_seed_gives_another_chunk_where_noise_is_drawn", "actions of another seed differ"),
        (Doubling, "actions_have_the_contracts_shape_and_come_from_the_seed_alone", "float64"),
        (Mixing, "a_batch_equals_its_rows_one_by_one", "numbers of row 0 in a batch are off by"),
        (Boasting, "the_end_of_an_unread_stream_is_a_control", "differ from those without"),
        (Passive, "the_action_is_made_in_a_stream", "part='action'"),
        (Otherwise, "inference_without_acting_equals_that_of_acting", "another activation at expert"),
    ],
)
def test_a_policy_that_breaks_a_promise_fails_its_check(
    broken: type[EncoderPolicy], name: str, reason: str, sound: EncoderPolicy, checkpoint: Path
) -> None:
    good = policy_subject(sound, checkpoint)
    CHECKS[name](good)
    bad = policy_subject(broken(sound.network, sound.card), checkpoint)
    with pytest.raises((CheckFailedError, probe_kit.ProbeKitError), match=re.escape(reason)) as failed:
        CHECKS[name](bad)
    assert isinstance(failed.value, probe_kit.ProbeKitError) or "; change: " in str(failed.value)


class Tapping(Pi0):
    """Taps heads where the MLP begins."""

    def tap(self, site: Site) -> Tap:
        tap = super().tap(site)
        if site.quantity != "heads":
            return tap
        return dataclasses.replace(tap, module=super().tap(dataclasses.replace(site, quantity="mlp")).module)


class Taking(EncoderPolicy):
    """Takes heads that it does not declare for what attention adds."""

    def tap(self, site: Site) -> Tap:
        return super().tap(dataclasses.replace(site, quantity=site.quantity.replace("heads", "attention")))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("heads_make_what_the_output_projection_adds", "are off by"),
        ("attention_patterns_are_the_models_own", "does not give what its heads read"),
    ],
)
def test_a_policy_that_taps_other_heads_fails_its_checks(
    name: str, reason: str, pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = policy_subject(pi0_tiny)
    CHECKS[name](subject)
    monkeypatch.setattr(pi0_tiny, "__class__", Tapping)
    with pytest.raises((CheckFailedError, probe_kit.ProbeKitError), match=reason):
        CHECKS[name](subject)


def test_heads_that_are_not_declared_and_not_refused_fail_their_check(
    sound: EncoderPolicy, checkpoint: Path
) -> None:
    head_check = CHECKS["heads_that_are_not_declared_are_refused_by_name"]
    head_check(policy_subject(sound, checkpoint))
    bad = policy_subject(Taking(sound.network, sound.card), checkpoint)
    with pytest.raises(CheckFailedError, match=r"tap\(backbone\.00\.heads\): no error"):
        head_check(bad)


def test_a_model_whose_lens_leaves_the_norm_out_fails_its_check(monkeypatch: pytest.MonkeyPatch) -> None:
    lens_check, vlm = CHECKS["the_last_row_of_the_logit_lens_is_the_output"], registry.load_model("vlm-tiny")
    subject = AnswerSubject(model=vlm)
    lens_check(subject)
    right = vlm.unembedding
    assert right is not None
    broken = dataclasses.replace(right, norm=torch.nn.Identity())
    monkeypatch.setattr(type(vlm), "unembedding", property(lambda _: broken))
    with pytest.raises(CheckFailedError, match=r"logits of the last layer of answer differ .*; change: Correct"):
        lens_check(subject)


# -- gradients -------------------------------------------------------------------------------------------------


class Sloped(EncoderPolicy):
    """Gives its actions with a graph too. shift: of their values. doubled: whether gradients are."""

    interventions = dataclasses.replace(EncoderPolicy.interventions, gradients=True)
    shift, doubled = 0.0, False

    def differentiable(self, observations: Sequence[Observation], seeds: Sequence[int]) -> Tensor:
        image = torch.stack(
            [torch.from_numpy(observation.image).permute(2, 0, 1) / 255 for observation in observations]
        )
        state = torch.from_numpy(np.stack([observation.state for observation in observations]))
        noise = [torch.randn(CHUNK, 7, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        raw = self.network(image, self._letters(observations), state, torch.stack(noise))
        actions = torch.cat([0.02 * raw[..., :6], raw[..., 6:].sigmoid()], -1) + self.shift
        return 2 * actions - actions.detach() if self.doubled else actions


class Shifted(Sloped):
    shift = 1e-3


class Doubled(Sloped):
    doubled = True


class Promising(EncoderPolicy):
    """Declares gradients and gives none."""

    interventions = Sloped.interventions


@pytest.mark.parametrize(
    ("broken", "name", "reason"),
    [
        (Shifted, "actions_with_a_graph_are_the_actions", "actions with a graph are off by 0.001"),
        (Doubled, "gradients_at_sites_are_central_differences", "a gradient of"),
    ],
)
def test_gradients_that_are_not_those_of_the_actions_fail_their_check(
    broken: type[EncoderPolicy], name: str, reason: str, sound: EncoderPolicy, checkpoint: Path
) -> None:
    CHECKS[name](policy_subject(Sloped(sound.network, sound.card), checkpoint))
    bad = policy_subject(broken(sound.network, sound.card), checkpoint)
    with pytest.raises(CheckFailedError, match=re.escape(reason)):
        CHECKS[name](bad)


def test_gradients_are_declared_or_refused_by_name(sound: EncoderPolicy, checkpoint: Path) -> None:
    name = "actions_with_a_graph_are_the_actions"
    with pytest.raises(SkipTest, match="declares no gradients"):
        CHECKS[name](policy_subject(sound, checkpoint))
    promising = Promising(sound.network, sound.card)
    with pytest.raises(NotImplementedError, match="does not implement `differentiable`"):
        CHECKS[name](policy_subject(promising, checkpoint))


# -- loading ---------------------------------------------------------------------------------------------------


def load_sloppily(checkpoint: str, *_: object, **__: object) -> EncoderPolicy:
    """Knows one untrained network, and hashes no file. `weights_seed` reaches it unread."""
    network = EncoderVLA()
    network.load_state_dict(read_weights(Path(checkpoint)).tensors)
    card = dataclasses.replace(load(checkpoint).card, settings={})
    return EncoderPolicy(network.eval(), card)


def subject_of(loader: str, checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> Subject:
    family = Family(
        "encoder-vla",
        "",
        None,
        loader,
        requirements=Requirements(needs_checkpoint=True),
    )
    entry = SimpleNamespace(name="encoder-vla", load=lambda: family, value="x:y", dist=None)
    monkeypatch.setattr(registry, "family_entries", lambda: [entry])
    return PolicySubject("encoder-vla", checkpoint)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("every_file_that_is_read_reaches_the_card", "the same settings after a change of config.json"),
        ("random_twins_differ_by_their_seed_and_repeat_by_it", "one untrained network only"),
    ],
)
def test_a_loader_that_breaks_a_promise_fails_its_check(
    name: str, reason: str, checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with subject_of("tests.support.encoder_vla.policy:load", checkpoint, monkeypatch) as good:
        CHECKS[name](good)
    sloppy = subject_of("tests.hooks.test_conformance:load_sloppily", checkpoint, monkeypatch)
    with sloppy as bad, pytest.raises((CheckFailedError, UsageError), match=reason):
        CHECKS[name](bad)


def test_weights_that_are_nearly_the_networks_are_found(
    sound: EncoderPolicy, checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loader compares nothing, so that a missing tensor stays as it was drawn."""

    def load_nearly(_: Subject, folder: Path) -> EncoderPolicy:
        network = EncoderVLA()
        network.load_state_dict(load_file(folder / "model.safetensors"), strict=False)
        return EncoderPolicy(network.eval(), sound.card)

    weights_check = CHECKS["weights_that_are_not_exactly_the_models_are_refused"]
    with subject_of("tests.support.encoder_vla.policy:load", checkpoint, monkeypatch) as subject:
        weights_check(subject)
        monkeypatch.setattr(Subject, "load", load_nearly)
        with pytest.raises(CheckFailedError, match="a checkpoint in which a tensor is missing: no error"):
            weights_check(subject)


def test_a_recorded_output_that_differs_fails_its_check(golden_pi0: Path, tmp_path: Path) -> None:
    """A reference that lies beside the checkpoint is compared without being asked for."""
    output_check, folder = CHECKS["recorded_outputs_are_reproduced"], tmp_path / "reference"
    shutil.copytree(golden_pi0, folder)
    output_check(PolicySubject("pi0", folder / "checkpoint"))
    with np.load(folder / "reference.npz") as stored:
        arrays = dict(stored)
    np.savez(folder / "reference.npz", **{**arrays, "actions": arrays["actions"] + 1})
    with pytest.raises(CheckFailedError, match="other values of actions;"):
        output_check(PolicySubject("pi0", folder / "checkpoint"))


@pytest.mark.parametrize("family", ["pi0", "smolvla"])
def test_a_checkpoint_is_copied_with_the_files_that_lie_beside_it(family: str) -> None:
    """pi0's sizes and tokenizer lie beside the folder, and smolvla's configuration names `../vlm`."""
    with PolicySubject(family, GOLDEN / family / "checkpoint") as subject:
        CHECKS["every_file_that_is_read_reaches_the_card"](subject)


# -- models that answer ----------------------------------------------------------------------------------------


def test_an_answer_model_without_a_picture_in_it_fails_the_checks_of_pictures() -> None:
    """It never looks, so that its roles promise a picture that is not read."""
    subject = AnswerSubject(model=PositionModel(likes("A"), always("A")))
    CHECKS["a_reading_has_a_logit_per_option_and_their_mass_is_a_share"](subject)
    CHECKS["what_is_spoken_repeats_and_is_as_long_as_asked"](subject)
    with pytest.raises(CheckFailedError, match=r"positions with the role image; expected: none.*; change: Build"):
        CHECKS["without_a_picture_nothing_of_it_is_left"](subject)
    with pytest.raises(CheckFailedError, match="one call with and without a picture: no error"):
        CHECKS["questions_with_and_without_a_picture_do_not_go_together"](subject)
    with pytest.raises(CheckFailedError, match=r"the options A and A: no error.*UsageError.*'same token'"):
        CHECKS["options_that_begin_alike_are_refused"](subject)


# -- the mechanism ---------------------------------------------------------------------------------------------


def test_the_contracts_name_every_check_once() -> None:
    for checks in (POLICY_CHECKS, ANSWER_CHECKS):
        assert len(checks) == len({str(listed_check) for listed_check in checks}) > 25


def test_every_check_is_a_sentence_with_an_advice() -> None:
    for declared_check in CHECKS.values():
        for text in (declared_check.sentence, declared_check.change):
            assert text.endswith("."), text
            assert text[0].isupper(), text
        assert len(declared_check.sentence.split()) <= 25


def test_pytest_is_imported_nowhere() -> None:
    """The checks run where it is not installed."""
    imported = [(path, alias.name) for path, node in package_nodes(ast.Import) for alias in node.names]
    imported += [(path, node.module or "") for path, node in package_nodes(ast.ImportFrom)]
    assert [path for path, module in imported if module.partition(".")[0] == "pytest"] == []


def test_a_failure_carries_the_advice_of_its_check_unless_it_has_its_own() -> None:
    def fails(change: str) -> Callable[[Any], None]:
        def body(_: Any) -> None:
            raise CheckFailedError("this", "that", change)

        return body

    with pytest.raises(CheckFailedError, match="seen: this; expected: that; change: Do it"):
        check("A promise.", "Do it.")(fails(""))(None)
    with pytest.raises(CheckFailedError, match="change: Do that"):
        check("A promise.", "Do it.")(fails("Do that."))(None)


def test_an_error_of_another_kind_is_not_taken_for_a_refusal() -> None:
    with pytest.raises(CheckFailedError, match="no error; expected: KeyError"), expect_refusal("it", KeyError):
        pass
    with pytest.raises(ValueError, match="other"), expect_refusal("it", KeyError):
        raise ValueError("other")
    unsaid = pytest.raises(CheckFailedError, match="a message about it that says 'name'")
    with unsaid, expect_refusal("it", KeyError, says="name"):
        raise KeyError("nothing")


def test_numbers_are_compared_bit_for_bit_and_with_their_shape() -> None:
    ones = np.ones(3, np.float32)
    require_bits(ones, ones.copy(), "one", "the other")
    require_bits(ones * np.nan, ones * np.nan, "one", "the other")
    with pytest.raises(CheckFailedError, match=r"one differ from the other by up to 1\.19e-07"):
        require_bits(np.nextafter(ones, 2), ones, "one", "the other")
    with pytest.raises(CheckFailedError, match=r"shape \(3,\); expected: \(2,\)"):
        require_bits(ones, ones[:2], "one", "the other")


def test_without_a_family_the_checks_of_loading_are_skipped(sound: EncoderPolicy) -> None:
    subject = policy_subject(sound)
    with pytest.raises(SkipTest, match="no family was named"):
        CHECKS["an_option_that_is_not_declared_is_refused"](subject)
