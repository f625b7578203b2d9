"""Settings: one declaration of a field makes keyword, option, file and identity."""

import json
import os
import shutil
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from probe_kit._terminal.field_options import command_with, options_of
from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.env.spec import PRESETS
from probe_kit.errors import RunDamagedError, SettingsMismatchError, UsageError
from probe_kit.extract import (
    AskSettings,
    EnvironmentSettings,
    ExtractSettings,
    LeRobotSource,
    extract_run,
    prepare,
)
from probe_kit.extract.config_files import read_config
from probe_kit.extract.extraction import open_checked
from probe_kit.extract.parts import ModelSettings
from probe_kit.extract.settings import SOURCES, run_label
from probe_kit.hashing import sha256_json
from probe_kit.hooks import Edit, Site
from probe_kit.retention import retention_table
from probe_kit.retention.report import report_html
from probe_kit.runs import Run, open_run, provenance, verify_run
from probe_kit.runs.records import HASH
from probe_kit.runs.store import locate
from probe_kit.suite import Suite, load_suite
from tests.support.begun_runs import play_first_episodes

ZERO = Edit("zero", (Site("backbone", 1),))
EVERY = {
    "checkpoint": "DIR", "options": {"unnorm_key": "bridge"}, "random_weights": True, "weights_seed": 3,
    "dtype": "bfloat16", "tokens": "all", "captured_calls": 4, "codec": "none", "protocol": "act2answer",
    "execute": 2, "rotation": "axis-angle", "capture_only": True, "edits": (ZERO,), "device": "cuda:1",
    "frames": "none", "env_workers": 1, "workers": 2, "ray": "auto", "inference_limit": 9.5,
    "capture_memory": 64.0, "allow_mixed": True,
    "batch": 8, "video": "all", "accept_units": True, "accept_ignored_inputs": True,
    "seed": 5, "label": "after", "suite": Path("mine"),
    "categories": ("color",), "items": 6, "wordings": ("named",), "max_steps": 7, "arm": "panda",
}  # fmt: skip
"""Another value than the default for every field of settings that play a scene."""
CAPTURE_TASK_SEED = {
    "tokens", "captured_calls", "codec", "later_views", "protocol", "execute", "rotation", "capture_only", "edits",
    "seed",
}  # fmt: skip


def value_of(name: str) -> Any:
    return {"later_views": "mean"}.get(name, EVERY.get(name))


def with_one(name: str) -> ExtractSettings:
    """Settings of which one field differs; what it needs beside itself has its other value too."""
    companions = {"inference_limit": {"workers": 1}, "later_views": {"captured_calls": 2}}.get(name, {})
    return ExtractSettings("pi0", **{name: value_of(name)} | companions)


def typed(*words: str) -> ExtractSettings:
    """Settings that a command line makes."""
    parsed: list[ExtractSettings] = []

    @command_with(*ExtractSettings.option_models())
    def command(values: Any) -> None:
        parsed.append(ExtractSettings.of_command(values))

    program = typer.Typer()
    program.command()(command)
    ended = CliRunner().invoke(program, words, catch_exceptions=False)
    assert ended.exit_code == 0, ended.output
    return parsed[0]


@pytest.mark.parametrize("name", sorted({*EVERY, "later_views"}))
def test_a_file_makes_the_settings_again_that_it_was_written_of(name: str) -> None:
    settings = with_one(name)
    assert settings != ExtractSettings("pi0")
    assert ExtractSettings(**json.loads(json.dumps(settings.config()))) == settings


@pytest.mark.parametrize("name", sorted({*EVERY, "later_views"} - {"max_steps", "arm"}))
def test_the_part_of_a_field_says_whether_it_is_identity(name: str) -> None:
    base = ExtractSettings("pi0", captured_calls=2 if name == "later_views" else 1)
    changed = with_one(name).identity() != base.identity()
    assert changed == (name in CAPTURE_TASK_SEED | {"random_weights", "dtype"})


def test_every_field_of_a_run_is_tried_above() -> None:
    parts = ("model", "capture", "task", "machine")
    fields = {name for part in parts for name in getattr(ExtractSettings("pi0"), part).__class__.model_fields}
    fields |= {*SOURCES[0].model_fields, "seed", "label"} - {"kind", "scene"}
    assert fields - {"family", "vectors", "later_views"} <= set(EVERY)


def test_a_command_line_and_keywords_make_the_same_settings() -> None:
    assert typed("--model", "expert") == ExtractSettings("expert")
    line = (
        "--model pi0 -M unnorm-key=bridge --categories Color,shape --items 4 --wordings named --batch auto "
        "--max-steps 7 --early-stop --picture-size 8x6 --captured-calls all --no-act --weights-seed 2 --seed 0"
    )
    keywords = ExtractSettings(
        "pi0", options={"unnorm_key": "bridge"}, categories=("color", "shape"), items=4, wordings=("named",),
        batch="auto", max_steps=7, early_stop=True, picture_size=(8, 6), captured_calls="all", capture_only=True,
        weights_seed=2,
    )  # fmt: skip
    assert typed(*line.split()) == keywords
    assert (keywords.scene.max_steps, keywords.scene.picture_shape) == (7, (6, 8))
    recorded = "--model pi0 --dataset kitchen --episodes 0:2,4 --select every:3 --camera base=top --rotate base=90"
    assert typed(*recorded.split(), "--no-pixels").source == LeRobotSource(
        "kitchen", episodes=(0, 1, 4), every=3, cameras={"base": "top"}, rotations={"base": 90}, pixels=False
    )
    played = "--model pi0 --env kitchen:Kitchen --env-option count=3 --max-steps 9 --episodes 1"
    expected = EnvironmentSettings("kitchen:Kitchen", options={"count": "3"}, max_steps=9, episodes=[1])
    assert typed(*played.split()).source == expected


def test_typed_options_replace_those_of_a_file(tmp_path: Path) -> None:
    source = LeRobotSource("kitchen", every=3)
    for settings, words in (
        (ExtractSettings("pi0", items=4, max_steps=7), {"items": 6, "seed": 2}),
        (ExtractSettings("pi0", source=source), {"episodes": "0:2"}),
    ):
        (tmp_path / "settings.json").write_text(json.dumps(settings.config()), encoding="utf-8")
        file = read_config(tmp_path / "settings.json")
        again = ExtractSettings.of_command(words, file)
        assert ExtractSettings.of_command({}, file) == settings
        assert again.scene.max_steps == 7 if "items" in words else again.source == source.changed(episodes=(0, 1))


def test_a_typed_model_replaces_that_of_a_file() -> None:
    file = ExtractSettings("idle", items=4).config()
    assert ExtractSettings.of_command({"model": "expert"}, file).model.family == "expert"
    assert ExtractSettings.of_command({"model": "expert"}, {"seed": 3}).model.family == "expert"


@pytest.mark.parametrize("command", ["extract", "ask"])
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"source": "kitchen"}, "source is 'kitchen'; expected its settings by name"),
        ({"capture": 3}, "capture is 3; expected its settings by name"),
        ({"captured": {}}, "has no setting 'captured'; is it capture?"),
    ],
)
def test_a_file_of_settings_that_holds_no_parts_is_refused_in_words(
    tmp_path: Path, command: str, wrong: dict[str, Any], message: str
) -> None:
    (tmp_path / "settings.json").write_text(
        json.dumps({"model": {"family": "vlm-tiny"}, **wrong}), encoding="utf-8"
    )
    line = [command, "--config", str(tmp_path / "settings.json"), "--dry-run"]
    ended = CliRunner().invoke(app, line)
    assert ended.exit_code == 2
    assert message in " ".join(ended.output.split())


def test_printed_settings_are_those_that_a_command_reads(tmp_path: Path) -> None:
    line = ["extract", "--model", "pi0-tiny", "--items", "2", "--print-config"]
    printed = CliRunner().invoke(app, line)
    assert printed.exit_code == 0, printed.output
    (tmp_path / "settings.json").write_text(printed.stdout, encoding="utf-8")
    again = CliRunner().invoke(app, ["extract", "--config", str(tmp_path / "settings.json"), "--print-config"])
    assert json.loads(again.stdout) == json.loads(printed.stdout)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"tokens": "some"}, "tokens is 'some'; expected one of pooled, all"),
        ({"items": 0}, "items is 0; expected at least 1"),
        ({"batch": 0}, "batch"),
        ({"workers": 2000}, "workers is 2000"),
        ({"wordings": ("sung",)}, "sung"),
        ({"inference_limit": 3.0}, "--workers 1"),
        ({"later_views": "mean"}, "--captured-calls"),
        ({"label": ""}, "label"),
        ({"suite": Path("x"), "source": LeRobotSource("kitchen")}, "--suite does not apply with --dataset"),
    ],
    ids=str,
)
def test_a_value_that_cannot_be_used_is_refused_by_its_name(values: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as refused:
        ExtractSettings("pi0", **values)
    assert message in str(refused.value)


def test_more_values_without_a_name_than_there_are_fields_are_refused() -> None:
    with pytest.raises(TypeError, match="takes from 1 to 3 positional arguments but 4 were given"):
        ExtractSettings("pi0", "checkpoint", "cuda")  # type: ignore[misc]
    with pytest.raises(TypeError, match="has 6 fields; 7 values are given"):
        ModelSettings("pi0", None, {}, False, 0, None, "cuda")


def test_an_unknown_name_is_refused_with_the_nearest_known_one() -> None:
    with pytest.raises(TypeError, match=r"'tokns'; is it tokens\?"):
        ExtractSettings("pi0", tokns="all")
    with pytest.raises(TypeError, match="execute"):
        AskSettings("vlm-tiny", execute=2)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"model": "pi0", "dataset": "a", "env": "b:C"}, "are 2 sources"),
        ({"model": "pi0", "select": "every:2"}, "is for recordings; give --dataset FOLDER too"),
        ({"model": "pi0", "env_option": ["a=1"]}, "is for environments"),
        ({"model": "pi0", "dataset": "a", "items": 2}, "--items does not apply with --dataset"),
        ({"items": 2}, "--model NAME"),
    ],
    ids=str,
)
def test_options_of_another_source_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as refused:
        ExtractSettings.of_command(values)
    assert message in str(refused.value)


def test_a_scene_value_of_zero_is_chosen_and_therefore_checked() -> None:
    with pytest.raises(Exception, match="max_steps"):
        ExtractSettings("expert", max_steps=0)


def test_settings_that_are_not_typed_come_from_protocol_model_or_class() -> None:
    assert ExtractSettings("expert", scene=None, arm=None, early_stop=False, items=None) == ExtractSettings(
        "expert"
    )
    assert ExtractSettings("expert", protocol="act2answer").scene.name == "act2answer"
    home = ExtractSettings("expert", protocol="act2answer", scene="vl-think").scene.home
    assert home == PRESETS["vl-think"]["home"]
    assert ExtractSettings("expert", scene=SceneSpec(max_steps=2)).changed(seed=1).scene == SceneSpec(max_steps=2)


def test_sources_share_the_options_that_mean_the_same() -> None:
    declared = [
        (declared_option.parameter, declared_option.option.metavar)
        for kind in SOURCES
        for declared_option in options_of(kind)
    ]
    shared = {name for name, _ in declared if [name for name, _ in declared].count(name) > 1}
    assert shared == {"episodes", "camera", "no_pixels", "rotate"}
    assert len(set(declared)) == len({name for name, _ in declared})


@pytest.mark.parametrize(
    ("settings", "label"),
    [
        (ExtractSettings("pi0"), "pi0"),
        (ExtractSettings("pi0", checkpoint=str(Path("runs") / "mine")), "pi0 · mine"),
        (ExtractSettings("openvla", options={"centre_crop": True}), "openvla · centre_crop=True"),
        (ExtractSettings("pi0", random_weights=True, weights_seed=2), "pi0 · twin 2"),
        (ExtractSettings("pi0", label="after fine-tuning"), "after fine-tuning"),
        (ExtractSettings("pi0", source=EnvironmentSettings("kitchen:Kitchen")), "pi0 · in kitchen:Kitchen"),
    ],
)
def test_the_label_of_a_run_names_the_options_that_set_it_apart(settings: ExtractSettings, label: str) -> None:
    assert run_label(settings) == label


def test_an_edited_run_is_called_so() -> None:
    assert run_label(ExtractSettings("pi0", edits=(ZERO,))).startswith("pi0 · edited ")


@pytest.mark.slow
def test_only_what_is_asked_is_drawn_of_the_embedded_suite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path))
    _, source = open_checked(ExtractSettings("expert", categories=("color",), items=2))
    assert len(source.rows(0)) == 4
    (drawn,) = (tmp_path / "suites").iterdir()
    assert {item.category for item in load_suite(drawn).items} == {"color"}


def test_a_policy_on_a_gpu_chooses_its_batch_unless_one_is_chosen() -> None:
    assert ExtractSettings("pi0", device="cuda").machine.batch == "auto"
    assert ExtractSettings("pi0", device="cuda:1", batch=1).machine.batch == 1
    assert ExtractSettings("pi0", device="cuda", env_workers=4).machine.batch == 1
    assert ExtractSettings("pi0").machine.batch == ExtractSettings("expert", device="cuda").machine.batch == 1


def test_the_settings_of_a_run_repeat_it_wherever_it_lies(small_suite: Suite, tmp_path: Path) -> None:
    settings = ExtractSettings(
        "expert", suite=small_suite.folder, categories=("color",), items=2, max_steps=2, env_workers=0
    )
    run = extract_run(settings, tmp_path / "run")
    for where in (tmp_path / "run", tmp_path / "run" / "run.json"):
        again = ExtractSettings.of_command({"env_workers": 0}, read_config(where))
        assert again == settings
    assert str(tmp_path) not in json.dumps(run.settings)
    assert prepare(again).identity() == prepare(settings).identity()


def test_a_run_whose_edits_need_vectors_is_not_repeated_without_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    edit = Edit("add", (Site("backbone", 1),), vector="left")
    config = ExtractSettings("pi0", edits=(edit,), vectors={"left": np.zeros(4, np.float32)}).config()
    monkeypatch.setattr(
        "probe_kit.runs.run.open_run", lambda *_, **__: SimpleNamespace(settings={"config": config})
    )
    with pytest.raises(UsageError, match="vectors, which no run stores"):
        read_config(tmp_path)


SHORT = SceneSpec(max_steps=2)


def expert(suite: Suite) -> ExtractSettings:
    return ExtractSettings("expert", suite=suite.folder, scene=SHORT, env_workers=0)


def test_a_scene_run_has_the_identity_and_the_plan_that_it_had(suite: Suite) -> None:
    """A hash that changes by accident would stop runs from being continued."""
    prepared = prepare(expert(suite))
    assert sha256_json(prepared.identity())[:16] == "627e1ff7dbbddd31"
    assert (
        sha256_json({"episodes": prepared.plan.columns, "suite_parent": prepared.plan.suite_parent})[:16]
        == "f31538462ceed37f"
    )
    assert prepared.default_name() == "expert-d7e6640b"


def elsewhere(monkeypatch: pytest.MonkeyPatch, **changes: object) -> None:
    """Pretend that this process computes somewhere else; versions are changed one by one."""
    actual = provenance.provenance_here

    def other_machine(*where: str) -> dict[str, object]:
        record = actual(*where)
        versions = {name: value for name, value in changes.items() if name in record["versions"]}
        other_changes = {name: value for name, value in changes.items() if name not in versions}
        return {**record, **other_changes, "versions": {**record["versions"], **versions}}

    monkeypatch.setattr("probe_kit.extract.extraction.provenance_here", other_machine)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"device": "cuda"}, r"device: stored 'cpu', here 'cuda'"),
        ({"torch": "1.0"}, r"versions\.torch: stored '.+', here '1\.0'"),
        ({"lerobot": "0.1"}, r"versions\.lerobot"),
        ({"transformers": "4.0"}, r"versions\.transformers"),
        ({"pybullet": "1.0"}, r"versions\.pybullet"),
        ({"dtype": "bfloat16"}, r"dtype"),
    ],
)
def test_a_run_is_not_continued_where_numbers_come_out_otherwise(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, str], message: str
) -> None:
    play_first_episodes(expert(suite), tmp_path / "run")
    elsewhere(monkeypatch, **change)
    with pytest.raises(SettingsMismatchError, match=message) as caught:
        extract_run(expert(suite), tmp_path / "run")
    assert "--allow-mixed" in str(caught.value)
    assert caught.value.exit_code == 3


@pytest.mark.slow
def test_a_mixed_run_says_so(suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    play_first_episodes(expert(suite), tmp_path / "run")
    elsewhere(monkeypatch, torch="1.0", device="cuda")
    run = extract_run(expert(suite).changed(allow_mixed=True), tmp_path / "run")
    assert run.mixed == ("device", "versions.torch")
    assert run.certificate["mixed"] == ["device", "versions.torch"]
    assert len(run.provenances) == 2
    assert verify_run(run.path, deep=True).ok
    table = retention_table([run])
    for text in (table.to_markdown(), table.to_latex("all"), str(table.notes), report_html([run], table)):
        assert "versions.torch" in text.replace("\\_", "_")


@pytest.mark.slow
def test_a_copy_of_a_run_does_not_count_beside_it(suite: Suite, tmp_path: Path) -> None:
    run = extract_run(expert(suite), tmp_path / "run")
    copy = open_run(shutil.copytree(run.path, tmp_path / "copy"))
    with pytest.raises(UsageError, match="once as its copy"):
        retention_table({"a": [run], "b": [copy]})


@pytest.mark.slow
def test_other_writers_interpreters_and_processes_are_no_other_numbers(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play_first_episodes(expert(suite), tmp_path / "run")
    elsewhere(monkeypatch, python="3.13.0", machine="aarch64", zarr="9")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    run = extract_run(expert(suite).changed(env_workers=1), tmp_path / "run")
    assert run.mixed == ()
    assert len(run.provenances) == 2


@pytest.mark.slow
def test_a_finished_run_opens_by_its_command_wherever_that_is(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    extract_run(expert(suite), tmp_path / "run")
    elsewhere(monkeypatch, torch="1.0")
    assert extract_run(expert(suite), tmp_path / "run").mixed == ()


@pytest.mark.slow
def test_provenance_is_stored_once_and_every_commit_names_it(suite: Suite, tmp_path: Path) -> None:
    run = extract_run(expert(suite), tmp_path / "run")
    (record,) = (run.path / "provenance").glob("*.json")
    commits = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(run.path.glob("commits/*.json"))]
    assert [commit["provenance"] for commit in commits] == [record.stem] * 4
    stored = json.loads(record.read_text(encoding="utf-8"))
    assert stored["device"] == "cpu"
    assert stored["versions"]["torch"] == version("torch")
    del stored[HASH]
    assert provenance.name_of(stored) == record.stem


def test_lost_or_changed_provenance_is_found(suite: Suite, tmp_path: Path) -> None:
    run = extract_run(expert(suite), tmp_path / "run")
    (record,) = (run.path / "provenance").glob("*.json")
    record.write_text(record.read_text(encoding="utf-8").replace('"cpu"', '"tpu"'), encoding="utf-8")
    assert "was changed" in verify_run(run.path).problems[0]
    record.unlink()
    assert "is missing" in verify_run(run.path).problems[0]
    assert Run(locate(run.path)).provenances == run.provenances, "the certificate says the same"
    assert extract_run(expert(suite), run.path).stamp == run.stamp
    assert verify_run(run.path).ok
    (run.path / "certificate.json").unlink()
    record.unlink()
    with pytest.raises(RunDamagedError, match=r"provenance/.* is missing.*run the same `probe-kit extract` again"):
        _ = Run(locate(run.path)).mixed
    assert extract_run(expert(suite), run.path).stamp == run.stamp
    assert verify_run(run.path).ok


def test_the_versions_of_the_machine_are_those_of_the_packages() -> None:
    record = provenance.provenance_here()
    assert {part.partition(".")[2] for part in provenance.DECISIVE} - {""} <= record["versions"].keys()
    assert os.sep not in json.dumps(record), "no path of this machine"


def test_who_plans_for_gpus_elsewhere_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    record = provenance.provenance_here("cuda:1", "bfloat16")
    assert (record["device"], record["device_name"], record["dtype"]) == ("cuda", None, "bfloat16")


@pytest.mark.slow
def test_allowing_a_mix_is_no_part_of_the_identity(suite: Suite) -> None:
    plain, allowed = prepare(expert(suite)), prepare(expert(suite).changed(allow_mixed=True))
    assert plain.identity() == allowed.identity()


def test_the_device_is_a_gpu_where_torch_finds_one_and_the_model_has_a_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def devices() -> list[str]:
        return [ExtractSettings(name).machine.device for name in ("pi0-tiny", "expert")]

    monkeypatch.setattr("probe_kit._system.machine._surely_without_gpu", lambda: True)
    assert devices() == ["cpu", "cpu"]
    monkeypatch.setattr("probe_kit._system.machine._surely_without_gpu", lambda: False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert devices() == ["cpu", "cpu"]
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert devices() == ["cuda", "cpu"]
    assert ExtractSettings("pi0-tiny").machine.batch == "auto"
    assert ExtractSettings("pi0-tiny", device="cpu").machine.device == "cpu"
