"""`--protocol`: one row per family, what is given wins, and every difference is written down."""

import json
from pathlib import Path
from typing import Any

import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import UsageError
from probe_kit.extract import AskSettings, ExtractSettings, extract_run, prepare, protocols
from probe_kit.extract.protocols import check_protocol, protocol_scene
from probe_kit.extract.settings import run_label
from probe_kit.hooks.contract.declared import check_options
from probe_kit.hooks.registry import own_families
from probe_kit.retention.report.page import provenance
from probe_kit.suite import Suite
from tests.hooks.families.pi0.checkpoints import write_intact

# Section 4 of what is known of the release, in the words of the command line.
RELEASED = {
    "pi0": {
        "checkpoint": "juexzz/INTACT-pi0-finetune-bridge", "execute": "1", "rotation": "axis-angle",
        "dtype": "bfloat16",
        "-M statistics": "bridge", "-M picture": "squashed", "-M openness": "release",
    },
    "openvla": {
        "checkpoint": "gen-robot/openvla-7b-rlvla-sft_16k", "execute": "1", "rotation": "roll-pitch-yaw",
        "dtype": "bfloat16",
        "-M unnorm_key": "sft", "-M temperature": "0.6", "-M top_k": "checkpoint",
        "-M resize": "tensor", "-M centre_crop": "false",
    },
    "spatialvla": {
        "checkpoint": "IPEC-COMMUNITY/spatialvla-4b-224-pt", "execute": "1", "rotation": "roll-pitch-yaw",
        "dtype": "bfloat16",
        "-M unnorm_key": "bridge_orig/1.0.0", "-M prompt": "bare", "-M lowercase": "false", "-M ensemble": "false",
    },
    "magma": {
        "checkpoint": "microsoft/Magma-8B", "execute": "1", "rotation": "roll-pitch-yaw",
        "dtype": "bfloat16", "-M unnorm_key": "bridge_orig",
        "-M prompt": "act2answer", "-M temperature": "0.7", "-M shrink": "256",
    },
    "xiaomi-r0": {
        "checkpoint": "XiaomiRobotics/Xiaomi-Robotics-0-SimplerEnv-WidowX", "execute": "4",
        "rotation": "axis-angle", "dtype": "bfloat16",
        "-M robot": "bridge_delta", "-M steps": "5", "-M openness": "release",
    },
    "internvla-m1": {
        "checkpoint": "InternRobotics/InternVLA-M1-Pretrain-RT-1-Bridge", "execute": "1", "rotation": "axis-angle",
        "dtype": "bfloat16",
        "-M unnorm_key": "bridge_dataset", "-M weights": "steps_50000_pytorch_model.pt",
        "-M steps": "10", "-M guidance": "1.5",
    },
}  # fmt: skip


def protocol_identity(settings: ExtractSettings) -> dict[str, Any]:
    return protocols.protocol_identity(settings.model, settings.task, settings.source)


def deviations(settings: ExtractSettings) -> dict[str, Any]:
    """By setting, what the protocol has and what the run has."""
    return dict(protocol_identity(settings).get("protocol", {}).get("deviations", {}))


def test_every_model_of_the_release_that_is_here_has_its_row() -> None:
    rows = {name: family.protocols["act2answer"].settings() for name, family in own_families().items()
            if "act2answer" in family.protocols}  # fmt: skip
    assert rows == RELEASED


@pytest.mark.parametrize(
    ("checkpoint", "variant", "unnorm_key"),
    [
        (None, "SFT", "sft"),
        ("gen-robot/openvla-7b-rlvla-sft_16k", "SFT", "sft"),
        ("gen-robot/openvla-7b-rlvla-rl", "RL", "bridge_orig"),
        ("openvla/openvla-7b", "base", "bridge_orig"),
    ],
)
def test_openvla_has_a_row_per_checkpoint_and_labels_say_which_it_is(
    checkpoint: str | None, variant: str, unnorm_key: str
) -> None:
    settings = ExtractSettings("openvla", checkpoint, protocol="act2answer").followed()
    shared = {"temperature": 0.6, "top_k": "checkpoint", "resize": "tensor", "centre_crop": False}
    assert dict(settings.model.options) == {"unnorm_key": unnorm_key, **shared}
    assert deviations(settings) == {}
    assert protocol_identity(settings)["protocol"]["variant"] == variant
    assert run_label(settings) == f"openvla · act2answer · {variant}"
    assert ExtractSettings("openvla", settings.model.checkpoint, protocol="act2answer").followed() == settings


@pytest.mark.parametrize("name", RELEASED)
def test_the_options_of_a_row_are_the_familys_own(name: str) -> None:
    """What a loader would refuse is refused here, without one."""
    family = own_families()[name]
    for row in (row for first in family.protocols.values() for row in first.rows):
        options = row.options_for(None)
        assert check_options(name, family.options, options) == options


@pytest.mark.parametrize("name", RELEASED)
def test_a_row_and_its_options_are_those_of_the_checkpoint_at_any_revision(name: str) -> None:
    for row in (row for first in own_families()[name].protocols.values() for row in first.rows):
        at_commit = f"{row.checkpoint}@{'a' * 40}"
        settings = ExtractSettings(name, row.checkpoint, protocol="act2answer").followed()
        pinned = ExtractSettings(name, at_commit, protocol="act2answer").followed()
        assert pinned == settings.changed(checkpoint=at_commit)


@pytest.mark.parametrize("name", RELEASED)
def test_options_that_are_not_typed_are_as_in_the_release(name: str) -> None:
    settings = ExtractSettings(name, protocol="act2answer").followed()
    assert settings.scene == SceneSpec.preset("act2answer")
    assert deviations(settings) == {}
    assert run_label(settings) == f"{name} · act2answer" + (" · SFT" if name == "openvla" else "")
    assert settings.followed() == settings


def test_a_typed_option_overrides_the_protocol_and_is_recorded_as_a_deviation() -> None:
    magma_settings = ExtractSettings(
        "magma", options={"temperature": "0", "tokenizer": "words"}, execute=1, dtype="float32",
        protocol="act2answer", scene=protocol_scene("act2answer", tile_side=0.2033),
    )  # fmt: skip
    settings = magma_settings.followed()
    assert settings.model.options["temperature"] == "0"
    assert settings.model.options["prompt"] == "act2answer"
    assert deviations(settings) == {
        "dtype": ["bfloat16", "float32"],
        "-M temperature": ["0.7", "0"],
        "-M tokenizer": [None, "words"],
        "scene tile_side": ["0.1452", "0.2033"],
    }
    assert "scene tile_side=0.2033" in run_label(settings)


def test_the_protocol_of_pi0_deviates_in_its_pictures_and_not_in_its_statistics() -> None:
    unmatched = protocol_identity(ExtractSettings("pi0", protocol="act2answer").followed())["protocol"][
        "unmatched"
    ]
    assert any("Lanczos" in line and "bilinearly" in line for line in unmatched)
    assert not any("statistics" in line for line in unmatched)


def test_another_scene_that_is_asked_for_is_kept_and_reported() -> None:
    bridge = protocol_scene("act2answer", "bridge")
    settings = ExtractSettings("magma", protocol="act2answer", scene=bridge).followed()
    assert settings.scene == SceneSpec()
    assert deviations(settings)["scene arm"] == ["widowx", "panda"]
    assert protocol_scene(None) == SceneSpec()


def test_a_vlm_is_asked_in_the_scene_of_the_protocol_or_the_one_that_is_named() -> None:
    size = {"picture_size": (224, 224)}
    by_protocol = AskSettings("vlm-tiny", protocol="act2answer", **size)
    by_scene = AskSettings("vlm-tiny", scene="act2answer", **size)
    assert by_protocol.scene == by_scene.scene == protocol_scene("act2answer", **size)
    assert by_protocol.identity() == by_scene.identity()
    both = AskSettings("vlm-tiny", protocol="act2answer", scene="frontal", **size)
    assert both.scene == protocol_scene(None, "frontal", **size)
    assert AskSettings("vlm-tiny", protocol="act2answer").scene == protocol_scene("act2answer")
    with pytest.raises(UsageError, match="unknown protocol 'act3answer'"):
        AskSettings("vlm-tiny", protocol="act3answer")


def test_how_a_protocol_differs_from_the_default_is_in_the_run() -> None:
    protocol = protocol_identity(ExtractSettings("magma", protocol="act2answer").followed())["protocol"]
    assert protocol["name"] == "act2answer"
    assert protocol["differs_from_default"]["-M temperature"] == ["0.7", "0"]
    assert not [name for name in protocol["differs_from_default"] if name.startswith("scene")]
    assert "-M unnorm_key" not in protocol["differs_from_default"]
    assert protocol["unmatched"]
    assert protocol_identity(ExtractSettings("magma")) == {}


def test_options_of_the_protocols_checkpoint_do_not_follow_another_one() -> None:
    fine_tuned = ExtractSettings("openvla", "my/fine-tune", protocol="act2answer").followed()
    assert "unnorm_key" not in fine_tuned.model.options
    assert fine_tuned.model.options["temperature"] == 0.6
    assert set(deviations(fine_tuned)) == {"checkpoint", "-M unnorm_key"}
    assert "SFT" not in run_label(fine_tuned)


def test_the_conversion_of_rotations_is_the_protocols_unless_another_is_asked_for() -> None:
    assert ExtractSettings("pi0", protocol="act2answer").followed().task.rotation == "axis-angle"
    assert ExtractSettings("magma", protocol="act2answer").followed().task.rotation == "roll-pitch-yaw"
    plain = ExtractSettings("pi0", protocol="act2answer", rotation="roll-pitch-yaw").followed()
    assert deviations(plain) == {"rotation": ["axis-angle", "roll-pitch-yaw"]}
    assert plain.identity()["rotation"] == "roll-pitch-yaw"
    assert ExtractSettings("pi0", protocol="act2answer", capture_only=True).followed().task.rotation is None
    with pytest.raises(UsageError, match="expected one of roll-pitch-yaw, axis-angle"):
        ExtractSettings("pi0", rotation="quaternion")  # type: ignore[arg-type]


def test_a_script_follows_the_scene_alone() -> None:
    settings = ExtractSettings("idle", protocol="act2answer").followed()
    assert settings.scene == SceneSpec.preset("act2answer")
    assert (settings.model.checkpoint, dict(settings.model.options), deviations(settings)) == (None, {}, {})


def test_protocols_that_are_not_there_are_refused() -> None:
    with pytest.raises(UsageError, match="Did you mean act2answer"):
        check_protocol("act2anwser")
    with pytest.raises(UsageError, match="available: act2answer"):
        ExtractSettings("pi0", protocol="simpler")
    with pytest.raises(UsageError, match="does not use smolvla; it uses pi0, openvla"):
        prepare(ExtractSettings("smolvla", protocol="act2answer"))


@pytest.mark.slow
def test_a_run_names_its_protocol_and_the_report_lists_what_differs(small_suite: Suite, tmp_path: Path) -> None:
    """A tiny checkpoint of the protocol's kind, in the protocol's scene; two actions instead of eighty."""
    settings = ExtractSettings(
        "pi0", str(write_intact(tmp_path / "pi0")), options={"statistics": "bridge"}, protocol="act2answer",
        dtype="float32", suite=small_suite.folder, categories=("color",), items=2,
        scene=protocol_scene("act2answer", max_steps=2), env_workers=0,
    )  # fmt: skip
    run = extract_run(settings, tmp_path / "run")
    protocol = run.settings["protocol"]
    assert set(protocol["deviations"]) == {"checkpoint", "dtype", "scene max_steps"}
    assert run.settings["execute"] == 1
    assert run.settings["policy"]["openness"] == "release"
    assert run.settings["rotation"] == run.certificate["rotation"] == "axis-angle"
    assert run.label == "pi0 · act2answer · checkpoint=pi0 · dtype=float32 · scene max_steps=2"
    assert len(run.episodes) == 4
    facts = dict(provenance("pi0", run, [])["facts"])
    assert facts["protocol"] == "act2answer"
    assert "scene max_steps 2 instead of 80" in facts["deviates from it in"]
    assert "-M openness release instead of measured" in facts["it differs from the default in"]
    again = prepare(settings.changed(workers=0), tmp_path / "run")
    assert json.loads(json.dumps(again.identity())) == run.root.own_settings
