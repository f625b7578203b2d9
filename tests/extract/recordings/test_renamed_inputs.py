"""The names in a checkpoint's files and in a data set decide what is shown: the rename map, and `--feature`."""

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import CheckpointError, RecordingError, UsageError
from probe_kit.extract import LeRobotSource
from probe_kit.extract.sources.recording_source import RecordingSource
from probe_kit.hooks.contract.card import DeclaredInputs
from probe_kit.hooks.families.shared.kinds import ACTION, IMAGES, STATE
from probe_kit.hooks.families.shared.lerobot.pipelines import PREPROCESSOR, declared_inputs, rename_map
from probe_kit.models.embedded import embedded_checkpoint

PICTURES = (f"{IMAGES}a", f"{IMAGES}b", "wrist_image")
JOINTS, ACTIONS = "observation.joints", "actions"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures in names of lerobot and openpi, two states and actions in other names than lerobot's."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    folder = tmp_path_factory.mktemp("renamed") / "rec"
    picture = {"dtype": "image", "shape": (16, 16, 3), "names": ["height", "width", "channel"]}
    numbers = {JOINTS: (8,), "state": (8,), ACTIONS: (7,)}
    features: dict[str, Any] = dict.fromkeys(PICTURES, picture)
    features |= {name: {"dtype": "float32", "shape": shape, "names": None} for name, shape in numbers.items()}
    data = LeRobotDataset.create("local/rec", 5, features, root=folder, use_videos=False)
    for frame in range(2):
        pictures = {name: np.full((16, 16, 3), 40 * at, np.uint8) for at, name in enumerate(PICTURES, start=1)}
        values = {name: np.full(shape, frame + at, np.float32) for at, (name, shape) in enumerate(numbers.items())}
        data.add_frame({**pictures, **values, "task": "push"})
    data.save_episode()
    data.finalize()
    return folder


def fine_tune(folder: Path, cameras: tuple[str, ...], renames: object) -> Path:
    """The embedded pi0 with these cameras, and the step of `lerobot-train --rename_map` as lerobot saves it."""
    from lerobot.processor import DataProcessorPipeline
    from lerobot.processor.rename_processor import RenameObservationsProcessorStep

    shutil.copytree(embedded_checkpoint("pi0-tiny"), folder)
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    picture = {"type": "VISUAL", "shape": [3, 16, 16]}
    config["input_features"] = {f"{IMAGES}{name}": picture for name in cameras} | {
        STATE: config["input_features"][STATE]
    }
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    step = RenameObservationsProcessorStep(rename_map=renames)  # type: ignore[arg-type]  # one test saves another
    DataProcessorPipeline(steps=[step], name=PREPROCESSOR).save_pretrained(folder / "saved")
    saved = json.loads((folder / "saved" / f"{PREPROCESSOR}.json").read_text(encoding="utf-8"))["steps"]
    content = json.loads((folder / f"{PREPROCESSOR}.json").read_text(encoding="utf-8"))
    content["steps"] = [*saved, *content["steps"]]
    (folder / f"{PREPROCESSOR}.json").write_text(json.dumps(content), encoding="utf-8")
    return folder


def inputs_of(folder: Path) -> DeclaredInputs:
    inputs = declared_inputs(folder)
    assert inputs is not None
    return inputs


def renamed_by_lerobot(renames: Mapping[str, str]) -> dict[str, str]:
    """Which feature of the data set a policy of lerobot is given under each name."""
    from lerobot.processor.rename_processor import RenameObservationsProcessorStep

    features = {name: name for name in (*PICTURES, JOINTS)}
    return dict(RenameObservationsProcessorStep(rename_map=dict(renames)).observation(features))


@pytest.mark.parametrize(
    ("cameras", "renames"),
    [
        (("a", "b"), {f"{IMAGES}a": f"{IMAGES}b", f"{IMAGES}b": f"{IMAGES}a"}),
        (("base", "wrist"), {f"{IMAGES}b": f"{IMAGES}base", f"{IMAGES}a": f"{IMAGES}wrist"}),
        (("base", "b"), {"wrist_image": f"{IMAGES}base"}),
        (("a", "empty_camera_0"), {f"{IMAGES}b": f"{IMAGES}empty_camera_0"}),
        (("a", "b"), {JOINTS: STATE}),
        (("b", "a"), {}),
    ],
    ids=["exchanged", "two", "openpi", "empty-camera", "state", "none"],
)
def test_a_policy_is_shown_what_lerobot_gives_it(
    cameras: tuple[str, ...], renames: dict[str, str], recording: Path, tmp_path: Path
) -> None:
    inputs = inputs_of(fine_tune(tmp_path / "tuned", cameras, renames))
    mapped = RecordingSource.open(LeRobotSource(str(recording)), False).mapped(inputs)
    renamed = renamed_by_lerobot(renames)
    assert inputs.cameras == cameras
    assert mapped.settings.cameras == tuple((camera, renamed[f"{IMAGES}{camera}"]) for camera in cameras)
    assert dict(mapped.settings.features).get(STATE) == renamed.get(STATE)
    assert (" → " in mapped.renamed) == bool(renames)


def test_the_state_of_the_map_and_of_an_option_are_read(recording: Path) -> None:
    source = RecordingSource.open(LeRobotSource(str(recording)), False)
    by_map = source.mapped(DeclaredInputs(("a",), 8, {JOINTS: STATE}))
    typed = RecordingSource.open(
        LeRobotSource(str(recording), features={STATE: "state", ACTION: ACTIONS}), False
    ).mapped(DeclaredInputs(("a",), 8, {JOINTS: STATE}))
    assert by_map.reader.numbers(0, [STATE])[STATE][:, 0].tolist() == [0, 1]
    numbers = typed.reader.numbers(0, [STATE, ACTION])
    assert [numbers[name][:, 0].tolist() for name in (STATE, ACTION)] == [[1, 2], [2, 3]]
    assert f"{STATE} is given state, and the map says {JOINTS}" in typed.renamed
    assert typed.identity(1)["dataset"]["features"] == [[STATE, "state"], [ACTION, ACTIONS]]


def test_a_contradiction_is_said_and_the_option_counts(recording: Path) -> None:
    exchanged = {f"{IMAGES}a": f"{IMAGES}b", f"{IMAGES}b": f"{IMAGES}a"}
    source = RecordingSource.open(LeRobotSource(str(recording), cameras={"a": f"{IMAGES}a"}), False)
    mapped = source.mapped(DeclaredInputs(("a", "b"), 8, exchanged))
    assert mapped.settings.cameras == (("a", f"{IMAGES}a"),)
    assert f"a is given {IMAGES}a, and the map says {IMAGES}b" in mapped.renamed


@pytest.mark.parametrize(
    ("renames", "settings", "message"),
    [
        ({f"{IMAGES}b": f"{IMAGES}a"}, {}, f"gives {IMAGES}a and {IMAGES}b to the camera a .*--camera a="),
        ({JOINTS: STATE, "state": STATE}, {}, f"both become {STATE}.*--feature {STATE}="),
        ({f"{IMAGES}top": f"{IMAGES}base"}, {}, f"rename map says {IMAGES}top → {IMAGES}base"),
        ({}, {"features": {STATE: "nothing"}}, "has no such feature; its features of numbers are .*state"),
        ({}, {"features": {STATE: "wrist_image"}}, "has it as image"),
    ],
)
def test_names_that_decide_nothing_are_refused_with_the_way(
    renames: dict[str, str], settings: dict[str, Any], message: str, recording: Path
) -> None:
    cameras = ("base", "a") if f"{IMAGES}top" in renames else ("a", "b")
    with pytest.raises(RecordingError, match=message):
        RecordingSource.open(LeRobotSource(str(recording), **settings), False).mapped(
            DeclaredInputs(cameras, 8, renames)
        )


def test_a_state_under_another_name_is_named_with_the_option(recording: Path) -> None:
    source = RecordingSource.open(LeRobotSource(str(recording)), False)
    message = rf"'{JOINTS}' and 'state' have 8 numbers.*--feature {STATE}={JOINTS}"
    with pytest.raises(RecordingError, match=message):
        source.check_state_width("pi0", 8)
    with pytest.raises(RecordingError, match="a data set of this robot"):
        source.check_state_width("pi0", 9)
    with pytest.raises(UsageError, match="Pictures are mapped with --camera"):
        LeRobotSource(str(recording), features={f"{IMAGES}a": "b"})


def _of_a_list(content: dict[str, Any]) -> None:
    content["steps"][0]["config"] = {"rename_map": ["x"]}


def _of_numbers(content: dict[str, Any]) -> None:
    content["steps"][0]["config"] = {"rename_map": {"x": 1}}


@pytest.mark.parametrize("change", [_of_a_list, _of_numbers])
def test_a_map_of_something_else_is_refused(change: Callable[[dict[str, Any]], None], tmp_path: Path) -> None:
    folder = fine_tune(tmp_path / "tuned", ("a",), {})
    file = folder / f"{PREPROCESSOR}.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    change(content)
    file.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(CheckpointError, match=rf"{PREPROCESSOR}\.json has the rename_map"):
        rename_map(folder)


@pytest.mark.parametrize(
    ("names", "description"),
    [
        ([["x", "y"], [*"zuvwt"]], "x, y, z, u, v, w, t"),
        (["a", "b"], "its 2 names do not fit: a, b"),
    ],
)
def test_names_of_a_data_set_are_shown_or_said(
    names: object, description: str, recording: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(recording, tmp_path / "rec")
    info = json.loads((folder / "meta" / "info.json").read_text(encoding="utf-8"))
    info["features"][ACTIONS]["names"] = names
    (folder / "meta" / "info.json").write_text(json.dumps(info), encoding="utf-8")
    source = RecordingSource.open(LeRobotSource(str(folder), features={ACTION: ACTIONS}), False)
    assert description in source.facts()[ACTION]
