"""Checks of the card and of loading, on copies of the checkpoint."""

import shutil
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

from probe_kit.errors import CheckpointError, ProbeKitError, UsageError, WeightsError
from probe_kit.hooks.checkpoints.folders import CONFIGURATIONS
from probe_kit.hooks.conformance.check import CheckFailedError, SkipTest, check, expect_refusal, require
from probe_kit.hooks.conformance.subject import Subject
from probe_kit.hooks.verify import CHECKPOINT_FOLDER, REFERENCE_FILE, verify_reference

_DAMAGES = {
    "missing": "a tensor is missing",
    "extra": "a tensor is there that the network lacks",
    "shape": "a tensor has another shape",
    "nan": "a tensor holds NaN",
}


@check(
    "The card names the weights, their number and the cameras.",
    "Fill in the ModelCard from what `load_weights` returns.",
)
def the_card_names_the_weights(subject: Subject) -> None:
    card = subject.model.card
    require(len(card.weights_sha256) == 64, f"weights_sha256 is {card.weights_sha256!r}", "64 hexadecimal digits")
    require(card.parameters > 0, f"{card.parameters} parameters", "the number of the network")
    require(bool(card.cameras), "no cameras", "the names of the cameras that the model reads")
    not_text = {name for name, value in card.settings.items() if not isinstance(value, str)}
    require(not not_text, f"settings {sorted(not_text)} are not text", "text values")


@check(
    "Every file that the loader reads reaches the card, by content.",
    "Put `content_hashes(side_files(folder))` into the card's settings.",
)
def every_file_that_is_read_reaches_the_card(subject: Subject) -> None:
    """Check that a space at the end of a configuration makes another identity."""
    copied = _copy(subject)
    configuration = next((copied / name for name in CONFIGURATIONS if (copied / name).is_file()), None)
    if configuration is None:
        raise SkipTest(f"the checkpoint has no {' or '.join(CONFIGURATIONS)}")
    before = subject.load(copied).card
    configuration.write_text(configuration.read_text(encoding="utf-8") + " ", encoding="utf-8")
    after = subject.load(copied).card
    require(before.weights_sha256 == after.weights_sha256, "other hashes of the same weights", "one hash")
    require(
        before.settings != after.settings,
        f"the same settings after a change of {configuration.name}",
        "settings that hold its hash",
    )


@check(
    "Every option reaches the card.",
    "Read the option in the loader and put its value into the card's settings.",
)
def every_option_reaches_the_card(subject: Subject) -> None:
    checkpoint, other_values = subject.checkpoint, subject.other_options
    if not other_values:
        raise SkipTest("the family declares no option of which another value is known")
    plain = subject.stored_card.settings
    for name, values in sorted(other_values.items()):
        reached = any(_settings(subject, checkpoint, name, value) != plain for value in values)
        require(reached, f"the same settings with {name}={' or '.join(map(repr, values))}", "other settings")


def _settings(subject: Subject, checkpoint: Path, name: str, value: object) -> Mapping[str, str] | None:
    """The card's settings with an option; None for a value that this checkpoint refuses, which has reached it."""
    try:
        return subject.load(checkpoint, **{name: value}).card.settings
    except ProbeKitError:
        return None


@check(
    "An option that is not declared is refused.",
    "Declare options as `Family(options=(Option(…),))`; take no **keywords in the loader.",
)
def an_option_that_is_not_declared_is_refused(subject: Subject) -> None:
    with expect_refusal("the option nonsense=1", UsageError, says="no model option nonsense"):
        subject.load(subject.checkpoint, nonsense=1)


@check(
    "Untrained networks differ by their seed, repeat by it, and say so in the card.",
    "Take `random_weights` and `weights_seed` in the loader; `models.building.initialise` draws them.",
)
def random_twins_differ_by_their_seed_and_repeat_by_it(subject: Subject) -> None:
    checkpoint, options = str(subject.checkpoint), subject.loading_options
    cards = [
        subject.family.load(checkpoint, random_weights=True, weights_seed=seed, options=options).card
        for seed in (1, 1, 2)
    ]
    hashes = [card.weights_sha256 for card in cards]
    require(hashes[0] == hashes[1], "two networks of seed 1 with different weights", "the same weights")
    require(hashes[1] != hashes[2], "networks of the seeds 1 and 2 with the same weights", "other weights")
    seeds = [card.weights_seed for card in cards]
    require(seeds == [1, 1, 2], f"cards with weights_seed {seeds}", "[1, 1, 2]")
    require(all(card.random_weights for card in cards), "a card without random_weights", "random_weights=True")


@check(
    "The card names a seed for requested random weights only.",
    "Set `weights_seed=weights_seed if random_weights else None`: a file has no seed, whatever it says of itself.",
)
def weights_of_a_file_have_no_seed(subject: Subject) -> None:
    seed = subject.stored_card.weights_seed
    require(seed is None, f"weights_seed {seed!r} for the weights of a file", "None")


@check(
    "Weights that are not exactly the network's are refused.",
    "Load with `read_weights` and `load_weights`, which compare every name, shape and value.",
)
def weights_that_are_not_exactly_the_models_are_refused(subject: Subject) -> None:
    """Load checkpoints in which one tensor is missing, extra, of another shape, or NaN."""
    for damage, words in _DAMAGES.items():
        copied = _copy(subject)
        _damage(copied, damage)
        with expect_refusal(f"a checkpoint in which {words}", WeightsError, CheckpointError):
            subject.load(copied)
        shutil.rmtree(copied)


@check(
    "Every output that was recorded from the original implementation is reproduced.",
    "Correct the adapter where `probe-kit verify` lists an output as over.",
)
def recorded_outputs_are_reproduced(subject: Subject) -> None:
    """Compare with the golden reference that holds the checkpoint, if there is one."""
    folder = subject.checkpoint.parent
    if subject.checkpoint.name != CHECKPOINT_FOLDER or not (folder / REFERENCE_FILE).is_file():
        raise SkipTest(f"the checkpoint lies beside no {REFERENCE_FILE}")
    verification = verify_reference(subject.name, folder)
    over = [comparison.output for comparison in verification.comparisons if comparison.status == "over"]
    require(
        verification.passed, f"other values of {', '.join(over) or 'nothing recorded'}", "those of the reference"
    )


def _copy(subject: Subject) -> Path:
    """Return a copy of the checkpoint, beside links to what lies beside the original.

    Some layouts name files outside their folder, such as sizes, a tokenizer or a vision-language model at
    `../vlm`.

    Raises:
        SkipTest: Where the family loads by no name.
    """
    source, folder = subject.checkpoint, subject.folder
    assert subject.family
    for path in source.parent.iterdir():
        if path.name != source.name:
            (folder / path.name).symlink_to(path.resolve())
    return Path(shutil.copytree(source, folder / source.name))


def _damage(folder: Path, damage: str) -> None:
    """Change one tensor of the last safetensors file of weights."""
    files = sorted(folder.glob("model*.safetensors"))
    if not files:
        raise SkipTest(f"{folder} holds no model*.safetensors to damage")
    tensors = load_file(files[-1])
    blocks = [name for name in sorted(tensors) if ".layers." in name or ".blocks." in name] or sorted(tensors)
    if not blocks:
        raise CheckFailedError(f"{files[-1].name} holds no tensor", "the weights of the network")
    name = blocks[0]
    if damage == "missing":
        del tensors[name]
    elif damage == "extra":
        tensors["not.in.the.network.weight"] = torch.ones(2)
    elif damage == "shape":
        tensors[name] = torch.cat([tensors[name], tensors[name]])
    else:
        tensors[name] = torch.full_like(tensors[name], torch.nan)
    save_file(tensors, files[-1])
