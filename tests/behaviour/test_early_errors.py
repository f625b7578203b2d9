"""What needs no weights is refused before torch is imported: all such mistakes, in one light process."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from probe_kit.suite import Suite

ONE_AFTER_THE_OTHER = """
import contextlib, io, json, sys
from probe_kit.cli import app
answers = []
for arguments in json.load(sys.stdin):
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        try:
            app(arguments)
        except SystemExit as error:
            code = error.code
    heavy = [name for name in ("torch", "lerobot", "transformers", "pybullet") if name in sys.modules]
    answers.append([code, said.getvalue(), heavy])
json.dump(answers, sys.stdout)
"""
EXTRACT = "extract --model"
CASES = {
    f"{EXTRACT} pi0-tyni": (2, "Did you mean 'pi0-tiny'"),
    f"{EXTRACT} pi0 --checkpoint ./nowhere": (3, "does not exist"),
    f"{EXTRACT} pi0 --checkpoint empty": (3, "config.json is missing"),
    f"{EXTRACT} pi0 --checkpoint of-another-model": (3, "holds a 'act' model; expected pi0"),
    f"{EXTRACT} smolvla --checkpoint damaged": (3, "is not JSON"),
    f"{EXTRACT} pi0 --checkpoint without-weights": (3, "neither model.safetensors"),
    f"{EXTRACT} pi0 --checkpoint with-a-shard-missing": (3, "b.safetensors of model.safetensors.index.json"),
    f"{EXTRACT} prismatic": (2, "answers and does not act"),
    f"{EXTRACT} pi0-tiny --device nonsense": (2, "This machine has cpu"),
    f"{EXTRACT} pi0-tiny --dtype int8": (2, "is not one of"),
    f"{EXTRACT} pi0-tiny -M foo=3": (2, "no model option foo"),
    f"{EXTRACT} pi0-tiny --weights-seed 3": (2, "random weights"),
    f"{EXTRACT} pi0-tiny --scene moon": (2, "moon"),
    f"{EXTRACT} pi0-tiny --suite nowhere": (2, "is not a suite"),
    f"{EXTRACT} pi0-tiny --suite SUITE --categories colour": (2, "Did you mean 'color'"),
    f"{EXTRACT} pi0-tiny --suite SUITE --out file/run": (2, "is not a folder"),
    f"{EXTRACT} pi0-tiny --suite SUITE --seed 7 --max-steps 3 --out a-run": (
        3,
        "scene.max_steps: stored 2, asked 3",
    ),
    "verify pi0 nowhere": (2, "is not a golden reference"),
    "verify pi0 reference": (3, "holds a 'smolvla' model"),
    "verify pi0-tiny --keys nowhere": (2, "cannot be verified"),
    "verify pi0 --keys nowhere": (2, "does not exist"),
    "train nowhere": (2, "is not a run"),
    "train a-run --device nonsense": (2, "This machine has cpu"),
    "retention nowhere": (2, "is not a run"),
    "run verify nowhere": (2, "is not a run"),
    "run export nowhere --format h5": (2, "is not a run"),
    "models --run nowhere": (2, "is not a run"),
}


@pytest.fixture(scope="module")
def folder(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoints with something missing, a reference of another model, and a run that is there."""
    folder = tmp_path_factory.mktemp("early")

    def made(name: str, **files: str) -> Path:
        (folder / name).mkdir(parents=True)
        for file, content in files.items():
            (folder / name / file.replace("__", ".")).write_text(content, encoding="utf-8")
        return folder / name

    made("empty")
    made("of-another-model", config__json='{"type": "act"}')
    made("damaged", config__json="{")
    made("without-weights", config__json='{"type": "pi0"}')
    shards = {"weight_map": {"one": "a.safetensors", "two": "b.safetensors"}}
    place = made("with-a-shard-missing", config__json='{"type": "pi0"}', a__safetensors="")
    (place / "model.safetensors.index.json").write_text(json.dumps(shards), encoding="utf-8")
    np.savez(made("reference") / "reference.npz", out_actions=np.zeros(2, np.float32))
    made("reference/checkpoint", config__json='{"type": "smolvla"}')
    (folder / "file").touch()
    from probe_kit.env import SceneSpec
    from probe_kit.extract import ExtractSettings, extract_run

    settings = ExtractSettings("expert", suite=small_suite.folder, items=2, seed=7, scene=SceneSpec(max_steps=2))
    extract_run(settings, folder / "a-run")
    return folder


@pytest.fixture(scope="module")
def answers(folder: Path, small_suite: Suite) -> dict[str, tuple[int, str, list[str]]]:
    arguments = [[word.replace("SUITE", str(small_suite.folder)) for word in case.split()] for case in CASES]
    done = subprocess.run(
        [sys.executable, "-c", ONE_AFTER_THE_OTHER], input=json.dumps(arguments), cwd=folder, encoding="utf-8",
        capture_output=True, check=True, timeout=300,
    )  # fmt: skip
    return dict(zip(CASES, (tuple(answer) for answer in json.loads(done.stdout)), strict=True))


@pytest.mark.parametrize("case", CASES)
def test_a_mistake_that_needs_no_weights_is_named_before_anything_heavy_is_loaded(
    case: str, answers: dict[str, tuple[int, str, list[str]]]
) -> None:
    code, message = CASES[case]
    said = answers[case][1].replace("\n", " ")
    assert (answers[case][0], answers[case][2]) == (code, []), said
    assert message in said


def test_families_say_what_they_need(monkeypatch: pytest.MonkeyPatch) -> None:
    import huggingface_hub

    from probe_kit.hooks import family
    from probe_kit.hooks.registry import known_families

    monkeypatch.setattr(family, "find_spec", lambda name: None if name == "timm" else name)
    monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", lambda *_: None)
    known = known_families()
    assert known["pi0-tiny"].missing() == ""
    assert known["pi0"].missing() == "download of juexzz/INTACT-pi0-finetune-bridge, google/paligemma-3b-pt-224"
    assert known["openvla"].missing() == "extra openvla and download of openvla/openvla-7b"
    assert known["prismatic"].missing().startswith("extra openvla and download of TRI-ML/prismatic-vlms/prism-")


def test_a_cached_config_without_weights_is_no_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import huggingface_hub

    from probe_kit.hooks.registry import known_families as families

    (tmp_path / "config.json").touch()
    monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", lambda *_: str(tmp_path / "config.json"))
    assert families()["pi0"].missing() == "download of juexzz/INTACT-pi0-finetune-bridge"
    (tmp_path / "model.safetensors").touch()
    assert families()["pi0"].missing() == ""


def test_a_family_without_its_extra_is_refused_with_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    from probe_kit.errors import MissingExtraError
    from probe_kit.hooks import family
    from probe_kit.hooks.registry import known_families as families

    monkeypatch.setattr(family, "find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"needs timm.*install.*openvla"):
        families()["openvla"].check("somewhere")
