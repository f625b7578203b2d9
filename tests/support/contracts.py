"""The checkpoints on which every family is held to the contract of adapters, with their options."""

import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.hooks import Observation, Prompt
from probe_kit.hooks.conformance.check import Check
from probe_kit.hooks.conformance.subject import INSTRUCTIONS, AnswerSubject, PolicySubject, Subject
from probe_kit.hooks.families.internvla.checkpoint import convert
from probe_kit.hooks.family import SIZE
from probe_kit.hooks.testing import CONTRACTS
from probe_kit.models.embedded import embedded_checkpoint
from tests.hooks.families.groot import checkpoints as groot_checkpoints
from tests.hooks.families.internvla import checkpoints as internvla_checkpoints
from tests.hooks.families.magma import checkpoints as magma_checkpoints
from tests.hooks.families.pi0 import checkpoints as pi0_checkpoints
from tests.hooks.families.prismatic import checkpoints as prismatic_checkpoints
from tests.hooks.families.smolvla import checkpoints as smolvla_checkpoints
from tests.hooks.families.spatialvla import checkpoints as spatialvla_checkpoints
from tests.support.every_checkpoint import WRITERS

GOLDEN = Path(__file__).parents[1] / "golden"
UNTRIED = {"pi0": {"unread"}, "magma": {"unnorm_key", "statistics"}, "internvla-m1": {"weights"}}
"""Options of which another value needs a file of its own; tests of the family have them."""
_BRIDGE = "bridge_orig/1.0.0"
MECHANISMS = {
    "every_option_reaches_the_card",
    "hooks_are_gone_after_an_exception",
    "nested_captures_are_refused",
    "attention_patterns_are_the_models_own",
    "actions_with_a_graph_are_the_actions",
    "gradients_at_sites_are_central_differences",
}
"""Checks of code that all families share; edits stay in the default suite, because taps are of each family."""
LOADING = {
    "every_file_that_is_read_reaches_the_card",
    "random_twins_differ_by_their_seed_and_repeat_by_it",
    "weights_that_are_not_exactly_the_models_are_refused",
}
"""Checks of code that families with the same loader share."""


@dataclass(frozen=True)
class Case:
    """A checkpoint of a family.

    write: where its files lie, from an empty folder; None for the writer of `WRITERS`. options: besides those of
    `WRITERS`, None to leave one of them out. extras: of options, values that are not in use; from the folder that
    was written. If it is given, every option but the `UNTRIED` has one. kind: as what it is checked. typical:
    whether checks of shared code are not slow.
    """

    family: str
    write: Callable[[Path], Path] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    extras: Callable[[Path], dict[str, Any]] | None = None
    kind: type[Subject] = PolicySubject
    instructions: Sequence[str] = INSTRUCTIONS
    dtype: str | None = None
    slow: bool = False
    typical: bool = False

    def subject(self, folder: Path) -> Subject:
        write, options = WRITERS.get(self.family, (lambda _: folder, {}))
        checkpoint = (self.write or write)(folder)
        used = {name: value for name, value in {**options, **self.options}.items() if value is not None}
        more_options = self.extras(checkpoint) if self.extras else {}
        subject = self.kind(
            self.family,
            checkpoint,
            options=used,
            other_options=more_options,
            instructions=self.instructions,
            dtype=self.dtype,
        )
        if self.extras:
            untried = {option.name for option in subject.family.options} - subject.other_options.keys() - {SIZE}
            assert untried <= UNTRIED.get(self.family, set())
        return subject


def pairs(cases: Mapping[str, Case], shared: Collection[str]) -> list[Any]:
    """Every case with every check of its kind, as parameters of a test; `subject` is made in a fixture.

    shared: checks of code that these families share; they are slow for all but the typical ones.
    """

    def is_slow(case: Case, check: Check) -> bool:
        return case.slow or (check.name in shared and not case.typical)

    return [
        pytest.param(case, check, id=f"{name}-{check.name}", marks=[pytest.mark.slow] * is_slow(case, check))
        for name, case in cases.items()
        for check in next(checks for kind, checks in CONTRACTS.items() if issubclass(case.kind, kind))
    ]


def golden(name: str) -> Callable[[Path], Path]:
    return lambda _: GOLDEN / name / "checkpoint"


def golden_openvla_with_words(folder: Path) -> Path:
    """The golden reference holds ids, and no tokenizer."""
    shutil.copytree(GOLDEN / "openvla" / "checkpoint", folder, dirs_exist_ok=True)
    return prismatic_checkpoints.write_tokenizer(folder)


def base_of_groot(folder: Path) -> Path:
    return groot_checkpoints.write_groot(folder) / "base"


def openvla_of_two_data_sets(folder: Path) -> Path:
    bridge = prismatic_checkpoints.config_values()["norm_stats"]["bridge_orig"]
    other = {"action": {**bridge["action"], "q99": [0.2] * 7}}
    return prismatic_checkpoints.write_checkpoint(folder, norm_stats={"bridge_orig": bridge, "other": other})


def single_tower_mistral(folder: Path) -> Path:
    fields = {"vision": prismatic_checkpoints.SINGLE, "language": "mistral-v0.1-7b-pure"}
    prismatic_checkpoints.write_checkpoint(folder, **fields, image_resize_strategy="letterbox")
    return prismatic_checkpoints.write_tokenizer(folder)


def words_beside(folder: Path) -> str:
    (folder.parent / "words").mkdir(exist_ok=True)
    return str(prismatic_checkpoints.write_tokenizer(folder.parent / "words"))


def converted_internvla(folder: Path) -> Path:
    convert(str(internvla_checkpoints.write_checkpoint(folder)), folder / "converted")  # beside `vlm`
    return folder / "converted"


def internvlas_others(run: Path) -> dict[str, Any]:
    vlm = str(run.parent / "vlm")
    return {"steps": 5, "guidance": 1.0, "unnorm_key": "fractal20220817_data", "vlm": vlm, "tokenizer": vlm}


def spatialvla_of_two_arms(folder: Path) -> Path:
    bridge_statistics = spatialvla_checkpoints.processor_values()["statistics"][_BRIDGE]
    processor_statistics = {
        "statistics": {
            _BRIDGE: bridge_statistics,
            "my_arm": {"action": {**bridge_statistics["action"], "q99": [0.2] * 7}},
        }
    }
    return spatialvla_checkpoints.write_checkpoint(folder, processor=processor_statistics)


def spatialvlas_others(folder: Path) -> dict[str, Any]:
    (folder.parent / "letters").mkdir(exist_ok=True)
    letters = str(spatialvla_checkpoints.write_tokenizer(folder.parent / "letters"))
    return {"unnorm_key": "my_arm", "prompt": "question", "camera": "default", "iterations": "chunk",
            "tokenizer": letters}  # fmt: skip


class OfTwoCameras(PolicySubject):
    """Every row was seen by a camera of its own."""

    @cached_property
    def alike(self) -> list[Observation]:
        scene = np.array([[70, 0, 32], [0, 72, 24], [0, 0, 1]], np.float32)
        return [
            replace(observation, intrinsics=scene * [[1 + row], [1], [1]])
            for row, observation in enumerate(super().alike)
        ]


class OfWholePictures(PolicySubject):
    """Pictures of another shape than a square, hence maps stitched from several crops."""

    @cached_property
    def alike(self) -> list[Observation]:
        small, large, *remaining = super().alike
        return [small, replace(large, image=np.tile(large.image, (3, 1, 1))), *remaining]


class BegunAnswers(AnswerSubject):
    """A begun answer stands behind the frames."""

    def questions_of(self, observations: Sequence[Observation]) -> list[Prompt]:
        return [replace(question, begun="It is ") for question in super().questions_of(observations)]


_GOLDEN_WORDS = ("open the drawer", "pick up the red cube and place it on the tray", "open the tray")
_LETTERS = ("Put the cube on the star", "Put the cube on the red shape", "Put the cube on the stir")
_MAGMA: dict[str, Any] = {"shrink": 0, "prompt": "act2answer", "temperature": 0.7}
LEROBOTS = {
    "pi0-tiny": Case("pi0-tiny", lambda _: embedded_checkpoint("pi0-tiny")),
    "pi0": Case("pi0", golden("pi0"), instructions=_GOLDEN_WORDS, slow=True),
    "pi0 of a protocol": Case(
        "pi0", options={"statistics": "bridge"}, slow=True,
        extras=lambda folder: {
            "statistics": str(pi0_checkpoints.write_statistics(folder.parent / "client.json")),
        },
    ),
    "pi05": Case("pi05"),
    "pi0-fast": Case(
        "pi0-fast", golden("pi0_fast"), extras=lambda _: {"captured_tokens": 3, "temperature": 0.5}, typical=True
    ),
    "molmoact2": Case("molmoact2"),
    "groot": Case(
        "groot", base_of_groot, {"embodiment": groot_checkpoints.TAG},
        lambda folder: {"embodiment": "other", "vlm": str(folder / "vlm")}, dtype="float32",
    ),
    "xvla": Case("xvla", extras=lambda _: {"domain": 1}),
    "eo1": Case("eo1"),
    "smolvla": Case("smolvla", typical=True),
    "smolvla, golden": Case("smolvla", golden("smolvla"), instructions=_GOLDEN_WORDS, slow=True),
    "smolvla with marked pictures, masked cameras and a fixed prefix": Case(
        "smolvla",
        lambda folder: smolvla_checkpoints.write_smolvla(
            folder, cameras=("top", "wrist"), add_image_special_tokens=True, empty_cameras=1, prefix_length=40
        ),
        slow=True,
    ),
}  # fmt: skip
NATIVE = {
    "openvla": Case(
        "openvla", openvla_of_two_data_sets, {"unnorm_key": "bridge_orig"},
        lambda folder: {"unnorm_key": "other", "prompt": "openvla-v01", "tokenizer": words_beside(folder),
                        "temperature": 0.6, "top_k": "7"},
    ),
    "openvla of one tower, Mistral and a tokenizer file": Case(
        "openvla", single_tower_mistral, slow=True,
        instructions=("Put the cube on the star", "take the red cube to the star", "Put the cube on the shape"),
    ),
    "openvla, golden": Case("openvla", golden_openvla_with_words, {"unnorm_key": "bridge_orig"}, slow=True),
    "spatialvla": Case(
        "spatialvla", spatialvla_of_two_arms, {"unnorm_key": _BRIDGE}, spatialvlas_others, OfTwoCameras, _LETTERS,
        slow=True,
    ),
    "spatialvla in whole chunks within slots by the training's camera": Case(
        "spatialvla", spatialvla_of_two_arms,
        {"iterations": "chunk", "constrained": True, "camera": _BRIDGE, "unnorm_key": _BRIDGE},
        instructions=_LETTERS, slow=True,
    ),
    "spatialvla without depth": Case(
        "spatialvla",
        lambda folder: spatialvla_checkpoints.write_checkpoint(
            folder, use_vision_zoe=False, vision_zoe_config=None
        ),
        instructions=_LETTERS,
    ),
    "magma": Case("magma", extras=lambda folder: {**_MAGMA, "tokenizer": str(folder)}, typical=True),
    "magma with whole pictures": Case("magma", options={"shrink": 0}, kind=OfWholePictures, slow=True),
    "magma that draws": Case("magma", options={"temperature": 0.7}, slow=True),
    "xiaomi-r0": Case(
        "xiaomi-r0", extras=lambda folder: {"robot": "fractal", "steps": 3, "tokenizer": str(folder)}
    ),
    "xiaomi-r0 as the Google robot in three steps": Case(
        "xiaomi-r0", options={"robot": "fractal", "steps": 3}, slow=True
    ),
    "internvla-m1": Case(
        "internvla-m1", extras=lambda run: {**internvlas_others(run), "weights": "steps_7_pytorch_model.pt"}
    ),
    "internvla-m1, converted": Case(
        "internvla-m1", converted_internvla, {"steps": 2}, internvlas_others, slow=True
    ),
    "internvla-m1 without guidance": Case("internvla-m1", options={"steps": 4, "guidance": 1.0}, slow=True),
}  # fmt: skip
ANSWERING = {
    "prismatic": Case(
        "prismatic",
        lambda folder: prismatic_checkpoints.write_checkpoint(folder, model_type="prismatic"),
        extras=lambda folder: {"steps": 2, "tokenizer": words_beside(folder)},
        kind=AnswerSubject,
        typical=True,
    ),
    "magma": Case(
        "magma",
        lambda folder: magma_checkpoints.write_checkpoint(folder, steered=False),
        extras=lambda folder: {**_MAGMA, "tokenizer": str(folder)},
        kind=BegunAnswers,
        slow=True,
    ),
    **{
        name: Case(
            name,
            extras=lambda folder: {"tokenizer": str(folder)},
            kind=AnswerSubject,
            typical=name == "qwen2.5-vl",
        )
        for name in ("paligemma", "qwen2.5-vl", "qwen3-vl", "internvl", "ovis2.5")
    },
}
