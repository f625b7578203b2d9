"""Tables of a study in MLflow and Weights & Biases; both libraries run without a server here."""

import json
from pathlib import Path

import pytest

from probe_kit._system.installing import install_command
from probe_kit.errors import MissingExtraError, UsageError
from probe_kit.study import LoadedStudy, make_table, track_study
from probe_kit.study.packing.trackers import VERSION_TAG, TrackedStudy, Tracker


def test_every_number_is_a_metric_named_by_table_and_system(played: LoadedStudy) -> None:
    tracked = TrackedStudy.of(played)
    metrics, name = tracked.metrics(), next(iter(tracked.tables))
    rows = make_table(played, name).numbers
    shown = {value for key, value in metrics.items() if key.startswith(f"{name}/") and key.endswith("/sr")}
    assert shown == {row["sr"] for row in rows if row["sr"] is not None}
    assert not any(str(played.study.folder) in key for key in metrics), "a location is no name"
    assert tracked.version == TrackedStudy.of(played).version


@pytest.mark.parametrize("tracker", ["mlflow", "wandb"])
def test_a_missing_library_is_named_with_its_extra(
    tracker: Tracker, played: LoadedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, tracker, None)
    with pytest.raises(MissingExtraError) as caught:
        track_study(played, tracker)
    assert install_command("trackers") in str(caught.value)


def test_another_tracker_is_refused(played: LoadedStudy) -> None:
    with pytest.raises(UsageError, match="no tracker 'paper'; choose mlflow or wandb"):
        track_study(played, "paper")  # type: ignore[arg-type]


@pytest.mark.slow
def test_mlflow_has_one_run_per_content(
    played: LoadedStudy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mlflow = pytest.importorskip("mlflow", reason="MLflow is not installed (extra `trackers`)")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    mlflow.set_tracking_uri(tmp_path.as_uri())
    logged, is_new = track_study(played, "mlflow")
    assert is_new
    assert track_study(played, "mlflow") == (logged, False)
    run = mlflow.get_run(logged)
    assert run.data.metrics == pytest.approx(TrackedStudy.of(played).metrics(), nan_ok=True)
    for name in played.study.tables:
        stored = json.loads(mlflow.artifacts.load_text(f"{run.info.artifact_uri}/tables/{name}.json"))
        assert stored["numbers"] == json.loads(json.dumps(list(make_table(played, name).numbers)))


@pytest.mark.slow
def test_wandb_gets_every_table_and_number(
    played: LoadedStudy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("wandb", reason="Weights & Biases is not installed (extra `trackers`)")
    for name, value in {"MODE": "offline", "DIR": str(tmp_path), "SILENT": "true"}.items():
        monkeypatch.setenv(f"WANDB_{name}", value)
    logged, is_new = track_study(played, "wandb")
    assert (is_new, len(logged)) == (True, 16)
    (stored,) = tmp_path.rglob("*.wandb")
    content = stored.read_bytes()
    assert VERSION_TAG.encode() in content
    for name in played.study.tables:
        assert f"tables/{name}".encode() in content
