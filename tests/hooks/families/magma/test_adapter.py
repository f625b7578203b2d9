"""References of other sizes, which code that is not ours records here, are reproduced too."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from probe_kit.errors import CheckpointError, InstructionError, ObservationError, UsageError, WeightsError
from probe_kit.hooks import Observation, Site, capture
from probe_kit.hooks.contract.model import Prompt
from probe_kit.hooks.families.magma.adapter import Magma, load_magma
from probe_kit.hooks.families.magma.checkpoint import ChatText
from probe_kit.hooks.families.magma.network import UNUSED_WEIGHTS, MagmaConfig, shipped_statistics
from probe_kit.hooks.testing import example_observations
from probe_kit.hooks.verify import verify_reference
from tests.hooks.families.magma.checkpoints import (
    IDS,
    LAYER_SCALE,
    config_values,
    small_network,
    weights,
    write_checkpoint,
    write_tokenizer,
)
from tests.hooks.families.magma.reference import write_reference

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
    observations = example_observations(INSTRUCTIONS)
    actions = loaded.act(observations, [0, 1])
    assert not loaded.flagged.any()
    prompts = [loaded.prompt(observation.instruction).ids for observation in observations]
    ids = loaded.generate(prompts, [loaded.picture(observation.image) for observation in observations]).ids.numpy()
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
    observation = example_observations(INSTRUCTIONS[:1])[0]
    state = np.array([*observation.state[:7], openness], np.float32)
    action = unsteered.act([Observation(observation.image, state, observation.instruction)], [0])[0, 0]
    assert unsteered.flagged.tolist() == [True]
    np.testing.assert_array_equal(action, [0, 0, 0, 0, 0, 0, gripper])


def test_seven_action_tokens_that_the_turn_does_not_end_behind_are_flagged(tmp_path: Path) -> None:
    """The released code would take the last seven of whatever comes."""
    network = small_network(steered=True)
    end = network.language_model.lm_head.weight[IDS["<|eot_id|>"]].clone()
    network.language_model.lm_head.weight[IDS["<|eot_id|>"], 7] = -16
    network.language_model.lm_head.weight[300] = end
    policy = load_magma(str(write_checkpoint(tmp_path, tensors=weights(network))), unnorm_key="bridge_orig")
    observations = example_observations(INSTRUCTIONS)
    assert np.abs(policy.act(observations, [0, 1])[:, 0, :6]).max() == 0
    assert policy.flagged.all()


def test_flags_belong_to_their_row(loaded: Magma, monkeypatch: pytest.MonkeyPatch) -> None:
    observations = example_observations(INSTRUCTIONS)
    is_action = loaded.action_tokens.__class__.is_action

    def second_is_text(self: object, ids: np.ndarray) -> np.ndarray:
        return is_action(self, ids) & (np.arange(len(ids)) != 1)[:, None]

    unflagged = loaded.act(observations, [0, 1])
    monkeypatch.setattr(loaded.action_tokens.__class__, "is_action", second_is_text)
    flagged = loaded.act(observations, [0, 1])
    assert loaded.flagged.tolist() == [False, True]
    np.testing.assert_array_equal(flagged[0], unflagged[0])
    assert np.abs(flagged[1, 0, :6]).max() == 0


def test_what_is_generated_behind_the_action_fires_no_tap(loaded: Magma) -> None:
    """Seven calls, though an eighth token was looked at."""
    with capture(loaded, loaded.sites()) as activations:
        loaded.act(example_observations(INSTRUCTIONS), [0, 1])
    assert set(activations.fires.values()) == {7}
    language_model, twin = loaded.network.language_model, loaded.network.unhooked()
    assert all(
        a.data_ptr() == b.data_ptr() for a, b in zip(language_model.parameters(), twin.parameters(), strict=True)
    )


def test_temperature_changes_actions_by_seed_alone(folder: Path) -> None:
    policy, observations = (
        load_magma(str(folder), temperature=5.0, unnorm_key="bridge_orig"),
        example_observations(INSTRUCTIONS[:1]),
    )
    drawn = {policy.act(observations, [seed]).tobytes() for seed in range(6)}
    assert len(drawn) > 1
    assert policy.act(observations, [3]).tobytes() == policy.act(observations, [3]).tobytes()


def test_statistics_of_other_than_seven_dimensions_do_not_act(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "six.json"
    file.write_text('{"six": {"q01": [0, 0, 0, 0, 0, 0], "q99": [1, 1, 1, 1, 1, 1]}}', encoding="utf-8")
    policy = load_magma(str(folder), statistics=str(file), unnorm_key="six")
    with pytest.raises(CheckpointError, match="6 dimensions"):
        policy.act(example_observations(INSTRUCTIONS[:1]), [0])


# -- inputs ----------------------------------------------------------------------------------------------


def test_the_token_count_comes_from_the_pictures_size(folder: Path) -> None:
    small = example_observations(INSTRUCTIONS[:1])[0]
    wide = Observation(np.tile(small.image, (1, 3, 1)), small.state, small.instruction)
    counts = {}
    for shrink in (0, 64):
        policy = load_magma(str(folder), shrink=shrink, unnorm_key="bridge_orig")
        for name, observation in (("small", small), ("wide", wide)):
            with capture(policy, [Site("backbone", 0)]) as activations:
                policy.act([observation], [0])
            roles = policy.roles([observation])["backbone"][0]
            assert len(roles) == activations[Site("backbone", 0)].shape[1]
            counts[shrink, name] = int(roles.mask("image").sum()), int(roles.mask("separator").sum())
    assert counts[0, "small"] == counts[64, "small"] == counts[64, "wide"] == (4, 2)
    assert counts[0, "wide"] == (12, 2)


def test_roles_point_at_what_they_name(loaded: Magma) -> None:
    """Compared with the embeddings themselves."""
    observation = example_observations(INSTRUCTIONS[:1])[0]
    with capture(loaded, [Site("backbone", 0)]) as activations:
        loaded.act([observation], [0])
    tokens, roles = activations[Site("backbone", 0)][0], loaded.roles([observation])["backbone"][0]
    separator = loaded.network.multi_modal_projector.row_seperator[0, 0]
    assert torch.equal(tokens[roles.mask("separator")], separator.expand(int(roles.mask("separator").sum()), -1))
    picture = loaded.network.look([loaded.picture(observation.image)])[0]
    assert torch.equal(tokens[roles.mask("image") | roles.mask("separator")], picture)
    embeddings = loaded.network.language_model.model.embed_tokens.weight
    words = [int((embeddings == token).all(dim=1).nonzero()[0, 0]) for token in tokens[roles.mask("language")]]
    assert loaded.text.decode(words) == "What action should the robot take to Put the cube on the star?"


def test_what_does_not_fit_is_refused_whole(loaded: Magma) -> None:
    observations = example_observations(["Put the cube on the " + "very " * 300 + "red shape"])
    with pytest.raises(InstructionError, match="this model has 1024"):
        loaded.act(observations, [0])
    with pytest.raises(ObservationError, match="uint8"):
        loaded.act([Observation(np.zeros((4, 4)), observations[0].state, "go")], [0])


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
    observation = example_observations(INSTRUCTIONS[:1])[0]
    with capture(loaded, sites) as activations:
        loaded.act([observation], [0])
    crops = loaded.picture(observation.image).crops
    maps = loaded.network.vision_tower.stem(crops)
    for number, stage in enumerate(loaded.network.vision_tower.stages):
        maps = stage(maps)
        last = Site(f"vision_{number}", widths[f"vision_{number}"][0] - 1)
        assert torch.equal(activations[last], maps.flatten(2).transpose(1, 2))
        assert activations[last].shape[0] == len(crops)


# -- answering -------------------------------------------------------------------------------------------


def questions(count: int = 2) -> list[Prompt]:
    observations = example_observations([""] * count)
    texts = ["Is the star left (A) or right (B)?", "Do you see a square? A: yes, B: no"]
    return [Prompt(observation, text, ("A", "B")) for observation, text in zip(observations, texts, strict=False)]


def test_options_are_compared_by_the_logits_behind_the_prompt(unsteered: Magma) -> None:
    prompts = questions()
    reading = unsteered.read(prompts)
    for row, question in enumerate(prompts):
        ids = unsteered.text.prompt(question.text).ids
        with torch.inference_mode():
            logits = unsteered.network([ids], [unsteered.picture(question.observation.image)]).logits[0, -1]
        expected = logits[[unsteered.text.option(question.text, "", letter) for letter in "AB"]]
        np.testing.assert_allclose(reading.option_logits[row], expected.numpy(), rtol=0, atol=2e-5)
        share = torch.softmax(logits, dim=0)[[65 - 33, 66 - 33]].sum()
        assert float(reading.option_mass[row]) == pytest.approx(float(share), rel=1e-4)


def test_speaking_goes_on_greedily_and_can_be_asked_again(unsteered: Magma) -> None:
    prompts = questions()
    reading = unsteered.read(prompts)
    long, short, again = (unsteered.speak(reading, tokens) for tokens in (12, 3, 12))
    assert long == again
    assert unsteered.speak(reading, 0) == ["", ""]
    for row, question in enumerate(prompts):
        ids = unsteered.text.prompt(question.text).ids
        picture = [unsteered.picture(question.observation.image)]
        with torch.inference_mode():
            generated = unsteered.network.decode([ids], picture, steps=12).ids[0].tolist()
        assert long[row] == unsteered.text.decode(generated)
        assert short[row] == unsteered.text.decode(generated[:3])


def test_being_asked_is_one_inference_and_speaking_is_none(unsteered: Magma) -> None:
    prompts = questions()
    plain = unsteered.read(prompts)
    with capture(unsteered, unsteered.sites()) as activations:
        reading = unsteered.read(prompts)
        unsteered.speak(reading, 12)
    assert set(activations.fires.values()) == {7}
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


def renamed(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """As a loader that renames every gamma to weight saves it."""
    return {name.replace(".gamma", ".weight"): tensor for name, tensor in tensors.items()}


def test_a_head_that_is_tied_may_be_left_out_and_has_no_other_numbers(tmp_path: Path) -> None:
    tied = {**config_values()["text_config"], "tie_word_embeddings": True}
    network, head = small_network(text_config=tied), "language_model.lm_head.weight"
    tensors = {name: tensor.clone() for name, tensor in weights(network).items()}
    for name, stored in (
        ("both", tensors),
        ("one", {key: tensor for key, tensor in tensors.items() if key != head}),
    ):
        folder = write_checkpoint(tmp_path / name, tensors=stored, text_config=tied)
        loaded = load_magma(str(folder), unnorm_key="bridge_orig").loaded.network.state_dict()
        assert torch.equal(loaded[head], tensors[head])
    other = write_checkpoint(tmp_path / "other", tensors={**tensors, head: tensors[head] + 1}, text_config=tied)
    with pytest.raises(WeightsError, match=f"{head} differs from the tensor that config.json ties it to"):
        load_magma(str(other), unnorm_key="bridge_orig")


@pytest.mark.parametrize("shards", [1, 3])
def test_every_weight_comes_from_the_file(tmp_path: Path, shards: int) -> None:
    loaded = load_magma(str(write_checkpoint(tmp_path, shards=shards)), unnorm_key="bridge_orig").loaded
    expected = small_network(steered=True).state_dict()
    ours = loaded.network.state_dict()
    assert ours.keys() == expected.keys()
    assert all(torch.equal(ours[name], expected[name]) for name in expected)
    assert loaded.audit.tensors == len(expected)
    assert any("contrastive head" in note for note in loaded.notes)


def test_the_unread_head_may_be_missing_and_nothing_else(tmp_path: Path) -> None:
    tensors = weights(small_network(), head=False)
    assert not load_magma(
        str(write_checkpoint(tmp_path / "without", tensors=tensors)), unnorm_key="bridge_orig"
    ).loaded.notes
    for name in ("multi_modal_projector.row_seperator", "language_model.lm_head.weight", LAYER_SCALE):
        lacking = {other: tensor for other, tensor in tensors.items() if other != name}
        with pytest.raises(WeightsError, match=name):
            load_magma(str(write_checkpoint(tmp_path / name, tensors=lacking)), unnorm_key="bridge_orig")


def test_the_index_may_leave_the_unread_head_out_and_nothing_else(tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path)
    index = folder / "model.safetensors.index.json"
    listed = json.loads(index.read_text(encoding="utf-8"))["weight_map"]
    pruned = {name: file for name, file in listed.items() if name not in UNUSED_WEIGHTS}
    index.write_text(json.dumps({"weight_map": pruned}), encoding="utf-8")
    load_magma(str(folder), unnorm_key="bridge_orig")
    index.write_text(
        json.dumps({"weight_map": {n: f for n, f in pruned.items() if n != LAYER_SCALE}}), encoding="utf-8"
    )
    with pytest.raises(WeightsError, match=LAYER_SCALE):
        load_magma(str(folder), unnorm_key="bridge_orig")


def test_layer_scales_named_weight_are_the_released_files_and_the_card_says_so(tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path, tensors=renamed(weights(small_network())))
    loaded = load_magma(str(folder), unnorm_key="bridge_orig")
    assert torch.equal(loaded.network.state_dict()[LAYER_SCALE], small_network().state_dict()[LAYER_SCALE])
    assert "5 layer scales taken from tensors stored as .weight" in loaded.card.notes
    assert loaded.card.settings["layer_scale"] == "weight"
    with pytest.raises(WeightsError, match=r"5 layer scales .* as \.weight instead of .*layer_scale=gamma"):
        load_magma(str(folder), layer_scale="gamma", unnorm_key="bridge_orig")


def test_the_actions_of_a_file_do_not_depend_on_how_it_names_its_layer_scales(
    tmp_path: Path, observation: Observation
) -> None:
    tensors = weights(small_network(steered=True))
    folders = [
        write_checkpoint(tmp_path / name, tensors=stored)
        for name, stored in (("gamma", tensors), ("weight", renamed(tensors)))
    ]
    observations = [observation] * 2
    first, other = (
        load_magma(str(folder), prompt="act2answer", temperature=0.7, unnorm_key="bridge_orig").act(
            observations, [1, 2]
        )
        for folder in folders
    )
    np.testing.assert_array_equal(first, other)


def test_a_layer_scale_under_both_names_is_damage(tmp_path: Path) -> None:
    tensors = weights(small_network())
    tensors[LAYER_SCALE.replace(".gamma", ".weight")] = tensors[LAYER_SCALE] * 2
    with pytest.raises(WeightsError, match="1 layer scales twice"):
        load_magma(str(write_checkpoint(tmp_path, tensors=tensors)), unnorm_key="bridge_orig")


@pytest.mark.parametrize("rename", [dict, renamed])
def test_one_constant_layer_scale_is_damage_under_either_name(
    tmp_path: Path, rename: Callable[[dict[str, torch.Tensor]], dict[str, torch.Tensor]]
) -> None:
    tensors = weights(small_network())
    tensors[LAYER_SCALE] = torch.full_like(tensors[LAYER_SCALE], 1e-6)
    with pytest.raises(WeightsError, match=r"damaged checkpoint: .* 1 layer scales .*stages\.2\.blocks\.1"):
        load_magma(str(write_checkpoint(tmp_path, tensors=rename(tensors))), unnorm_key="bridge_orig")


def test_layer_scales_left_at_their_initial_value_are_damage(tmp_path: Path) -> None:
    """What the loader that dropped them saves under the right name."""
    tensors = weights(small_network())
    initial = {n: torch.full_like(t, 1e-6) if n.endswith(".gamma") else t for n, t in tensors.items()}
    with pytest.raises(WeightsError, match=r"damaged checkpoint: .* 5 layer scales .* 1e-06 in every feature"):
        load_magma(str(write_checkpoint(tmp_path, tensors=initial)), unnorm_key="bridge_orig")


def test_the_trunk_of_a_network_with_random_weights_does_something(tmp_path: Path) -> None:
    folder = str(write_checkpoint(tmp_path))
    twin = load_magma(folder, random_weights=True, unnorm_key="bridge_orig")
    assert float(twin.network.state_dict()[LAYER_SCALE].min()) == 1


def test_weights_are_as_the_file_says_or_as_asked(tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path, torch_dtype="bfloat16")
    assert load_magma(str(folder), unnorm_key="bridge_orig").card.dtype == "bfloat16"
    wide = load_magma(str(folder), dtype="float32", unnorm_key="bridge_orig")
    assert {parameter.dtype for parameter in wide.network.parameters()} == {torch.float32}
    with pytest.raises(UsageError, match="float16"):
        load_magma(str(folder), dtype="float16", unnorm_key="bridge_orig")


def entry(scale: float) -> dict[str, list[float]]:
    return {"q01": [-scale] * 7, "q99": [scale] * 7, "mask": [True] * 6 + [False]}


def test_statistics_come_from_the_package_the_checkpoint_or_a_file_and_the_last_alone_counts(
    tmp_path: Path,
) -> None:
    folder = write_checkpoint(tmp_path / "model")
    ours = load_magma(str(folder), unnorm_key="bridge_orig").statistics
    assert ours.low.tolist() == shipped_statistics()["bridge_orig"]["action"]["q01"]
    (folder / "dataset_statistics.json").write_text(
        json.dumps({"bridge_orig": {"action": entry(2)}}), encoding="utf-8"
    )
    assert load_magma(str(folder), unnorm_key="bridge_orig").statistics.high[0] == 2
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"norm_stats": {"bridge_orig": entry(3), "mine": entry(4)}}), encoding="utf-8")
    assert load_magma(str(folder), statistics=str(file), unnorm_key="bridge_orig").statistics.high[0] == 3
    mine = load_magma(str(folder), statistics=str(file), unnorm_key="mine")
    assert (mine.statistics.key, mine.statistics.high[0]) == ("mine", 4)
    with pytest.raises(UsageError, match="Choose"):
        load_magma(str(folder), unnorm_key="fractal")
    with pytest.raises(CheckpointError, match="is missing"):
        load_magma(str(folder), statistics=str(tmp_path / "nowhere.json"), unnorm_key="bridge_orig")


INPUTS = 11
VARIANTS = {
    "one crop, then four": (((40, 50), (130, 121)), 6, {}),
    "crops side by side, then above each other": (((40, 130), (130, 40)), 9, {"vision": {"img_size": 96}}),
    "the whole picture at once": (((64, 190), (130, 130)), 3, {"vision": {"img_anyres_strategy": "global"}}),
    "other sizes": (
        ((65, 64), (30, 400)),
        5,
        {
            "vision": {
                "max_num_crops": 6,
                "mm_hidden_size": 48,
                "mm_projector_type": "mlp3x_gelu",
                "mm_use_im_start_end": True,
                "timm_overrides": {"depths": [2, 1, 1, 2], "dims": [8, 16, 24, 48], "norm_eps": 1e-3},
            },
            "text": {"hidden_size": 48, "num_hidden_layers": 2, "num_key_value_heads": 4, "rms_norm_eps": 1e-3},
            "mm_use_image_start_end": False,
        },
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_nothing_is_tuned_to_one_reference(tmp_path: Path, variant: str) -> None:
    sizes, steps, fields = VARIANTS[variant]
    folder = write_reference(tmp_path, sizes, steps, seed=len(variant), **fields)
    verification = verify_reference("magma", folder)
    by_status = {
        comparison.output: (comparison.status, comparison.note) for comparison in verification.comparisons
    }
    assert {status for status, _ in by_status.values()} == {"ok"}, by_status
    with np.load(folder / "reference.npz") as recorded:
        assert len(by_status) == len(recorded.files) - INPUTS + 1  # the choice of crops is recorded elsewhere


CONFIG = MagmaConfig.from_json(config_values())


@pytest.fixture
def text_folder(tmp_path: Path) -> Path:
    return write_tokenizer(tmp_path)


def text(text_folder: Path, **options: bool) -> ChatText:
    return ChatText.of(text_folder, CONFIG, **options)


def test_the_question_is_told_from_the_frames_around_it(text_folder: Path) -> None:
    spoken = text(text_folder)
    prompt = spoken.prompt("Where is the star?")
    question_ids = [number for number, inside in zip(prompt.ids, prompt.question, strict=True) if inside]
    assert spoken.decode(question_ids) == "Where is the star?"
    frames = [number for number, inside in zip(prompt.ids, prompt.question, strict=True) if not inside]
    assert IDS["<image>"] in frames
    assert "talk and act" in spoken.decode(frames[: frames.index(IDS["<|eot_id|>"])])


@pytest.mark.parametrize("user_first", [False, True])
@pytest.mark.parametrize("question", ["see", "user", "Is it <here>?", "a\nb"])
def test_a_question_whose_words_stand_in_the_frames_too_is_found(
    text_folder: Path, question: str, user_first: bool
) -> None:
    spoken = text(text_folder, user_first=user_first)
    prompt = spoken.prompt(question)
    places = [position for position, inside in enumerate(prompt.question) if inside]
    assert spoken.decode([prompt.ids[position] for position in places]) == question
    assert places == list(range(places[0], places[-1] + 1))
    assert places[0] > prompt.ids.index(IDS["<image>"])


def test_a_begun_answer_stands_behind_the_frames(text_folder: Path) -> None:
    spoken = text(text_folder)
    plain, begun = spoken.prompt("Which?"), spoken.prompt("Which?", "The answer is ")
    assert begun.ids[: len(plain.ids)] == plain.ids
    assert sum(begun.question) == sum(plain.question)


def test_the_order_of_turns_can_be_the_releases(text_folder: Path) -> None:
    ours, theirs = text(text_folder).prompt("q?"), text(text_folder, user_first=True).prompt("q?")
    assert sorted(ours.ids) == sorted(theirs.ids)
    assert ours.ids.index(IDS["<image>"]) > theirs.ids.index(IDS["<image>"])


def test_a_checkpoints_own_template_is_used(text_folder: Path) -> None:
    template = "{{ bos_token }}{% for m in messages %}[{{ m.role }}]{{ m.content }}{% endfor %}#"
    (text_folder / "chat_template.jinja").write_text(template, encoding="utf-8")
    assert text(text_folder).decode(text(text_folder).prompt("q?").ids[-2:]) == "?#"
    (text_folder / "chat_template.jinja").write_text("{{ messages[1].content | upper }}", encoding="utf-8")
    with pytest.raises(CheckpointError, match="changes the words"):
        text(text_folder).prompt("where?")


@pytest.mark.parametrize("marker", ["<image>", "<|eot_id|>"])
def test_a_question_with_a_marker_in_it_is_refused(text_folder: Path, marker: str) -> None:
    with pytest.raises(InstructionError, match="stands for something else"):
        text(text_folder).prompt(f"Put it on {marker} now")


def test_an_option_is_its_first_token_behind_the_prompt(text_folder: Path) -> None:
    spoken = text(text_folder)
    assert spoken.decode([spoken.option("A or B?", "", "B")]) == "B"
    assert spoken.option("A or B?", "", "Bad") == spoken.option("A or B?", "", "B")
    with pytest.raises(UsageError, match="merges with the end of the prompt"):
        spoken.option("A or B?", "", "")


def test_text_ends_with_the_turn(text_folder: Path) -> None:
    spoken = text(text_folder)
    letter = spoken.option("q?", "", "x")
    assert spoken.ends >= {IDS["<|eot_id|>"]}
    assert spoken.decode([letter, letter, IDS["<|eot_id|>"], letter]) == "xx"
    assert spoken.decode([IDS["<|eot_id|>"]]) == ""


def test_another_models_tokenizer_is_refused(text_folder: Path, tmp_path: Path) -> None:
    assert text(text_folder).vocabulary == 512  # without the added tokens
    other = MagmaConfig.from_json(config_values(tokenizer_vocab_size=520))
    with pytest.raises(CheckpointError, match=r"512 ids before the added ones, config\.json says 520"):
        ChatText.of(text_folder, other)
    small = MagmaConfig.from_json(config_values(text={"vocab_size": 515}))
    with pytest.raises(CheckpointError, match=r"ids up to 520; this model has 515"):
        ChatText.of(text_folder, small)
    with pytest.raises(CheckpointError, match=r"tokenizer\.json is missing"):
        ChatText.of(tmp_path / "nowhere", CONFIG)


def test_the_beginning_is_the_tokenizers_own(text_folder: Path) -> None:
    file = text_folder / "tokenizer_config.json"
    file.write_text(
        json.dumps({**json.loads(file.read_text(encoding="utf-8")), "bos_token": {"content": "<|end_of_text|>"}}),
        encoding="utf-8",
    )
    assert text(text_folder).prompt("q?").ids[:2] == (IDS["<|begin_of_text|>"], IDS["<|end_of_text|>"])
