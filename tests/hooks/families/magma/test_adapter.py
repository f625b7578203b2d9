from pathlib import Path

import numpy as np
import pytest
import torch

from probe_kit.errors import CheckpointError, InstructionError, ObservationError, UsageError
from probe_kit.hooks import Observation, Site, capture
from probe_kit.hooks.contract.model import Prompt
from probe_kit.hooks.families.magma.adapter import Magma, load_magma
from probe_kit.hooks.testing import example_observations
from tests.support.magma_checkpoints import IDS, small_network, weights, write_checkpoint

INSTRUCTIONS = ["Put the cube on the star", "Put the cube on the red shape"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("magma"))


@pytest.fixture(scope="module")
def loaded(folder: Path) -> Magma:
    return load_magma(str(folder), unnorm_key="bridge_orig")


@pytest.fixture(scope="module")
def unsteered(tmp_path_factory: pytest.TempPathFactory) -> Magma:
    return load_magma(
        str(write_checkpoint(tmp_path_factory.mktemp("random"), steered=False)), unnorm_key="bridge_orig"
    )


# -- acting ----------------------------------------------------------------------------------------------


def test_seven_action_tokens_and_the_end_of_the_turn_make_an_action(loaded: Magma) -> None:
    seen = example_observations(INSTRUCTIONS)
    actions = loaded.act(seen, [0, 1])
    assert not loaded.flagged.any()
    prompts = [loaded.prompt(one.instruction).ids for one in seen]
    ids = loaded.generate(prompts, [loaded.picture(one.image) for one in seen]).ids.numpy()
    low, high = loaded.statistics.low, loaded.statistics.high
    centres = (np.linspace(-1, 1, 256)[:-1] + np.linspace(-1, 1, 256)[1:]) / 2
    values = centres[np.clip(512 - ids - 1, 0, 254)]
    expected = 0.5 * (values + 1) * (high - low) + low
    expected[:, 6] = values[:, 6] > 0.5
    np.testing.assert_allclose(actions[:, 0], expected.astype(np.float32), rtol=0, atol=1e-7)
    assert np.abs(actions[0] - actions[1]).max() > 0


@pytest.mark.parametrize(("openness", "gripper"), [(0.9, 1.0), (0.1, 0.0)])
def test_a_row_without_an_action_is_flagged_and_holds_still(
    unsteered: Magma, openness: float, gripper: float
) -> None:
    seen = example_observations(INSTRUCTIONS[:1])[0]
    state = np.array([*seen.state[:7], openness], np.float32)
    action = unsteered.act([Observation(seen.image, state, seen.instruction)], [0])[0, 0]
    assert unsteered.flagged.tolist() == [True]
    np.testing.assert_array_equal(action, [0, 0, 0, 0, 0, 0, gripper])


def test_seven_action_tokens_that_the_turn_does_not_end_behind_are_flagged(tmp_path: Path) -> None:
    """The released code would take the last seven of whatever comes."""
    network = small_network(steered=True)
    end = network.language_model.lm_head.weight[IDS["<|eot_id|>"]].clone()
    network.language_model.lm_head.weight[IDS["<|eot_id|>"], 7] = -16
    network.language_model.lm_head.weight[300] = end
    policy = load_magma(str(write_checkpoint(tmp_path, tensors=weights(network))), unnorm_key="bridge_orig")
    seen = example_observations(INSTRUCTIONS)
    assert np.abs(policy.act(seen, [0, 1])[:, 0, :6]).max() == 0
    assert policy.flagged.all()


def test_flags_belong_to_their_row(loaded: Magma, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = example_observations(INSTRUCTIONS)
    is_action = loaded.action_tokens.__class__.is_action

    def second_is_text(self: object, ids: np.ndarray) -> np.ndarray:
        return is_action(self, ids) & (np.arange(len(ids)) != 1)[:, None]

    whole = loaded.act(seen, [0, 1])
    monkeypatch.setattr(loaded.action_tokens.__class__, "is_action", second_is_text)
    flagged = loaded.act(seen, [0, 1])
    assert loaded.flagged.tolist() == [False, True]
    np.testing.assert_array_equal(flagged[0], whole[0])
    assert np.abs(flagged[1, 0, :6]).max() == 0


def test_what_is_generated_behind_the_action_fires_no_tap(loaded: Magma) -> None:
    """Seven calls, though an eighth token was looked at."""
    with capture(loaded, loaded.sites()) as tape:
        loaded.act(example_observations(INSTRUCTIONS), [0, 1])
    assert set(tape.fires.values()) == {7}
    own, twin = loaded.network.language_model, loaded.network.unhooked()
    assert all(a.data_ptr() == b.data_ptr() for a, b in zip(own.parameters(), twin.parameters(), strict=True))


def test_temperature_changes_actions_by_seed_alone(folder: Path) -> None:
    policy, seen = (
        load_magma(str(folder), temperature=5.0, unnorm_key="bridge_orig"),
        example_observations(INSTRUCTIONS[:1]),
    )
    drawn = {policy.act(seen, [seed]).tobytes() for seed in range(6)}
    assert len(drawn) > 1
    assert policy.act(seen, [3]).tobytes() == policy.act(seen, [3]).tobytes()


def test_statistics_of_other_than_seven_dimensions_do_not_act(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "six.json"
    file.write_text('{"six": {"q01": [0, 0, 0, 0, 0, 0], "q99": [1, 1, 1, 1, 1, 1]}}', encoding="utf-8")
    policy = load_magma(str(folder), statistics=str(file), unnorm_key="six")
    with pytest.raises(CheckpointError, match="6 dimensions"):
        policy.act(example_observations(INSTRUCTIONS[:1]), [0])


# -- inputs ----------------------------------------------------------------------------------------------


def test_the_token_count_comes_from_the_pictures_size(folder: Path) -> None:
    seen = example_observations(INSTRUCTIONS[:1])[0]
    wide = Observation(np.tile(seen.image, (1, 3, 1)), seen.state, seen.instruction)
    counts = {}
    for shrink in (0, 64):
        policy = load_magma(str(folder), shrink=shrink, unnorm_key="bridge_orig")
        for name, one in (("small", seen), ("wide", wide)):
            with capture(policy, [Site("backbone", 0)]) as tape:
                policy.act([one], [0])
            roles = policy.roles([one])["backbone"][0]
            assert len(roles) == tape[Site("backbone", 0)].shape[1]
            counts[shrink, name] = int(roles.mask("image").sum()), int(roles.mask("separator").sum())
    assert counts[0, "small"] == counts[64, "small"] == counts[64, "wide"] == (4, 2)
    assert counts[0, "wide"] == (12, 2)


def test_roles_point_at_what_they_name(loaded: Magma) -> None:
    """Compared with the embeddings themselves."""
    one = example_observations(INSTRUCTIONS[:1])[0]
    with capture(loaded, [Site("backbone", 0)]) as tape:
        loaded.act([one], [0])
    tokens, roles = tape[Site("backbone", 0)][0], loaded.roles([one])["backbone"][0]
    separator = loaded.network.multi_modal_projector.row_seperator[0, 0]
    assert torch.equal(tokens[roles.mask("separator")], separator.expand(int(roles.mask("separator").sum()), -1))
    picture = loaded.network.look([loaded.picture(one.image)])[0]
    assert torch.equal(tokens[roles.mask("image") | roles.mask("separator")], picture)
    asked = loaded.network.language_model.model.embed_tokens.weight
    words = [int((asked == token).all(dim=1).nonzero()[0, 0]) for token in tokens[roles.mask("language")]]
    assert loaded.text.decode(words) == "What action should the robot take to Put the cube on the star?"


def test_what_does_not_fit_is_refused_whole(loaded: Magma) -> None:
    seen = example_observations(["Put the cube on the " + "very " * 300 + "red shape"])
    with pytest.raises(InstructionError, match="this model has 1024"):
        loaded.act(seen, [0])
    with pytest.raises(ObservationError, match="uint8"):
        loaded.act([Observation(np.zeros((4, 4)), seen[0].state, "go")], [0])


@pytest.mark.parametrize(
    ("option", "value"),
    [("prompt", "openvla"), ("layer_scale", "beta"), ("shrink", -1), ("temperature", -1.0)],
)
def test_an_option_that_means_nothing_is_refused(folder: Path, option: str, value: object) -> None:
    with pytest.raises(UsageError, match=option):
        load_magma(str(folder), **{option: value}, unnorm_key="bridge_orig")


# -- capture ---------------------------------------------------------------------------------------------


def test_every_stage_of_the_trunk_is_a_stream_of_its_own_width(loaded: Magma) -> None:
    widths = {name: (stream.layers, stream.width) for name, stream in loaded.further_streams.items()}
    assert widths == {"vision_0": (2, 8), "vision_1": (2, 16), "vision_2": (3, 24), "vision_3": (2, 32)}
    sites = [site for stream in loaded.further_streams.values() for site in stream.sites()]
    one = example_observations(INSTRUCTIONS[:1])[0]
    with capture(loaded, sites) as tape:
        loaded.act([one], [0])
    crops = loaded.picture(one.image).crops
    maps = loaded.network.vision_tower.stem(crops)
    for number, stage in enumerate(loaded.network.vision_tower.stages):
        maps = stage(maps)
        last = Site(f"vision_{number}", widths[f"vision_{number}"][0] - 1)
        assert torch.equal(tape[last], maps.flatten(2).transpose(1, 2))
        assert tape[last].shape[0] == len(crops)


# -- answering -------------------------------------------------------------------------------------------


def questions(count: int = 2) -> list[Prompt]:
    seen = example_observations([""] * count)
    texts = ["Is the star left (A) or right (B)?", "Do you see a square? A: yes, B: no"]
    return [Prompt(one, text, ("A", "B")) for one, text in zip(seen, texts, strict=False)]


def test_options_are_compared_by_the_logits_behind_the_prompt(unsteered: Magma) -> None:
    asked = questions()
    reading = unsteered.read(asked)
    for row, question in enumerate(asked):
        ids = unsteered.text.prompt(question.text).ids
        with torch.inference_mode():
            logits = unsteered.network([ids], [unsteered.picture(question.observation.image)]).logits[0, -1]
        expected = logits[[unsteered.text.option(question.text, "", letter) for letter in "AB"]]
        np.testing.assert_allclose(reading.option_logits[row], expected.numpy(), rtol=0, atol=2e-5)
        share = torch.softmax(logits, dim=0)[[65 - 33, 66 - 33]].sum()
        assert float(reading.option_mass[row]) == pytest.approx(float(share), rel=1e-4)


def test_speaking_goes_on_greedily_and_can_be_asked_again(unsteered: Magma) -> None:
    asked = questions()
    reading = unsteered.read(asked)
    long, short, again = (unsteered.speak(reading, tokens) for tokens in (12, 3, 12))
    assert long == again
    assert unsteered.speak(reading, 0) == ["", ""]
    for row, question in enumerate(asked):
        ids = unsteered.text.prompt(question.text).ids
        picture = [unsteered.picture(question.observation.image)]
        with torch.inference_mode():
            whole = unsteered.network.decode([ids], picture, steps=12).ids[0].tolist()
        assert long[row] == unsteered.text.decode(whole)
        assert short[row] == unsteered.text.decode(whole[:3])


def test_being_asked_is_one_inference_and_speaking_is_none(unsteered: Magma) -> None:
    asked = questions()
    plain = unsteered.read(asked)
    with capture(unsteered, unsteered.sites()) as tape:
        reading = unsteered.read(asked)
        unsteered.speak(reading, 12)
    assert set(tape.fires.values()) == {7}
    np.testing.assert_array_equal(plain.option_logits, reading.option_logits)


def test_an_answer_ends_with_the_turn(loaded: Magma) -> None:
    """Steered weights put out seven action tokens and the end of the turn, whatever they are asked."""
    reading = loaded.read(questions())
    assert loaded.speak(reading, 20) == loaded.speak(reading, 7)
    assert all(loaded.speak(reading, 20))


def test_a_reading_of_another_model_is_refused(unsteered: Magma) -> None:
    reading = unsteered.read(questions())
    with pytest.raises(UsageError, match="does not come from this model"):
        unsteered.speak(type(reading)(reading.option_logits, reading.option_mass, None), 3)


# -- the card --------------------------------------------------------------------------------------------
