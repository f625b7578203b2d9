"""Runs of recordings and of environments in the viewer: no side, and all that they have."""

from pathlib import Path

import numpy as np
import pytest

from probe_kit.diagnose.diagnosis import FILE, FORMAT
from probe_kit.diagnose.results import Diagnosis, InputDiagnosis
from probe_kit.hashing import sha256_json
from probe_kit.intervene.kinds.image_swap import ImageSwap
from probe_kit.intervene.outcomes import ConditionOutcomes, key_of, save, settings_of
from probe_kit.runs import Run, open_run
from probe_kit.runs.layout import DIAGNOSES
from probe_kit.runs.records import as_json
from probe_kit.runs.results import write_bundle
from probe_kit.runs.thumbnails import decode_frames
from probe_kit.train import Target, train_probes
from probe_kit.view import write_viewer
from probe_kit.view.catalogue import Catalogue
from tests.support.recorded_run import CALLS, EVERY, write_recorded_run
from tests.view.payload_reader import floats, read_payload

CONDITIONS = ("clean", "image_swap", "frame_swap", "control_input")


def swap_inputs(run: Run) -> str:
    """Store an exchange of pictures that does half of the exchange of all inputs."""
    settings = settings_of(ImageSwap(), run)
    episodes = run.episodes
    sizes = np.array([0.0, 0.5, 1.0, 0.01])[:, None] + np.linspace(0, 0.001, len(episodes))
    outcomes = ConditionOutcomes(
        CONDITIONS, *(episodes[name].to_numpy(str) for name in ("episode_id", "item_id", "group_id", "category")),
        np.full(len(episodes), ""), sizes, sizes, np.zeros((4, len(episodes), 5)), np.zeros(len(episodes)),
        toward=sizes, size=sizes,
    )  # fmt: skip
    check = {"replay": {"compared": 1, "equal": 1}}
    save(run.location, settings, key_of(settings), outcomes, "", check)
    return key_of(settings)


def diagnose(run: Run, version: str = FORMAT) -> str:
    """Store a diagnosis of one input that decides, and of one that does not arrive."""
    measured = InputDiagnosis("picture", "decides", "", 0.8, (0.6, 0.9), 0.01, 0.9, 0.001, 36, 6, 36)
    settings = {"format": version, "stamp": run.stamp}
    key = sha256_json(settings)[:12]
    diagnosis = Diagnosis(key, run.label, 12, 6, (measured,))
    write_bundle(run.location, DIAGNOSES, key, {"settings": settings}, {FILE: as_json(diagnosis.to_json())}, {})
    return key


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Twelve recorded episodes of four inferences, with probes, an intervention and a diagnosis."""
    run = write_recorded_run(tmp_path_factory.mktemp("recorded") / "run")
    train_probes(run, target=Target.of_run(run, "dataset.state.x"), permutations=20)
    swap_inputs(run)
    diagnose(run)
    return open_run(run.path)


@pytest.fixture(scope="module")
def catalogue(recorded: Run) -> Catalogue:
    return Catalogue([recorded])


def test_a_run_of_recordings_opens_with_the_views_that_need_no_side(catalogue: Catalogue) -> None:
    _, run = read_payload(catalogue.script("run/run"))
    assert (run["sides"], run["views"]) == (False, ["overview", "map", "episodes"])
    assert (run["table"]["rows"], run["scene"], run["committed"]) == ([], None, 12)
    assert run["targets"] == [{"target": "dataset.state.x", "category": "all"}]
    for name in catalogue.names():
        assert read_payload(catalogue.script(name))[0] == name


def test_what_is_stored_is_shown_as_the_tables_of_the_commands(catalogue: Catalogue) -> None:
    _, results = read_payload(catalogue.script("run/results"))
    kinds = {table["kind"]: table for table in results["tables"]}
    assert list(kinds) == [
        "diagnosis of the inputs", "intervention image-swap", "probes of dataset.state.x", "predicted actions"
    ]  # fmt: skip
    swap = kinds["intervention image-swap"]
    assert [cell["text"] for cell in swap["rows"][0]][:2] == ["All", "picture"]
    assert swap["findings"] == ["All  decides: the action follows the picture, by 0.50 of what all inputs do."]
    assert kinds["diagnosis of the inputs"]["rows"][0][2]["text"] == "decides"
    assert [row[0]["text"] for row in kinds["predicted actions"]["rows"]] == ["dx", "grip"]


def test_a_diagnosis_of_another_version_is_refused_and_the_other_results_are_shown(tmp_path: Path) -> None:
    run = write_recorded_run(tmp_path / "run")
    keys = diagnose(run), diagnose(run, "probe_kit diagnosis 1")
    _, results = read_payload(Catalogue([open_run(run.path)]).script("run/results"))
    assert [(table["kind"], table["key"]) for table in results["tables"]] == [
        ("diagnosis of the inputs", keys[0]), ("predicted actions", "")
    ]  # fmt: skip
    (reason,) = results["refused"]
    assert f"{keys[1]}/settings.json has format probe_kit diagnosis 1; this version of probe_kit reads" in reason
    assert f"Remove diagnoses/{keys[1]} and run the same `probe-kit diagnose` again" in reason
    assert str(tmp_path) not in reason


def test_a_target_has_a_map_with_the_scores_of_its_probes(catalogue: Catalogue) -> None:
    _, target = read_payload(catalogue.script("run/target/0"))
    assert target["metric"] == "R²"
    assert target["score"].index(max(target["score"])) == 1, "the state was planted in the second layer"
    assert len(target["sites"]) == len(target["cells"]) == len(target["signal"])
    with pytest.raises(KeyError):
        catalogue.script("run/target/1")


def test_an_episode_shows_every_inference_and_predicted_beside_recorded_actions(
    recorded: Run, catalogue: Catalogue
) -> None:
    _, episode = read_payload(catalogue.script("run/e/00003"))
    steps = [EVERY * call for call in range(CALLS)]
    assert episode["inferences"] == episode["frames"]["steps"] == steps
    assert recorded.inputs is not None
    actions = episode["inputs"][0]
    assert [series["name"] for series in actions["series"]] == ["dx", "grip"]
    for number, series in enumerate(actions["series"]):
        for line, kind in zip(series["lines"], ("action", "prediction"), strict=True):
            np.testing.assert_array_equal(floats(line["values"]), recorded.inputs.read(kind)[3, :, 0, number])
    picture = catalogue.picture("run", 3)
    assert picture is not None
    decoded = np.stack(list(decode_frames(picture, CALLS))).astype(float)
    pixels = recorded.inputs.read("pixels")[3, :, 0]
    np.testing.assert_allclose(decoded.mean(axis=(1, 2)), pixels.mean(axis=(1, 2)), atol=8)


def test_an_export_of_recordings_is_the_same_bytes_again(recorded: Run, tmp_path: Path) -> None:
    contents = []
    for name in ("a", "b"):
        folder = write_viewer([recorded], tmp_path / name).parent
        files = [path for path in folder.rglob("*") if path.is_file()]
        contents.append({path.relative_to(folder): path.read_bytes() for path in files})
    assert contents[0] == contents[1]
    assert len([name for name in contents[0] if name.suffix == ".webp"]) == 12
