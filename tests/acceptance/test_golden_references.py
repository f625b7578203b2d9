"""Every family puts out what the original implementation put out, as `probe-kit verify` prints it."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.acceptance.product import ROOT, probe_kit

GOLDEN = ROOT / "tests" / "golden"
FAST = ("pi0", "openvla")
REFERENCES = {
    **{
        name: GOLDEN / name.replace("-", "_")
        for name in (
            *("pi0", "pi05", "pi0-fast", "smolvla", "molmoact2", "groot", "xvla", "eo1", "openvla", "prismatic"),
            *("magma", "spatialvla", "xiaomi-r0", "internvla-m1"),
        )
    },
    "paligemma": GOLDEN / "vlm" / "paligemma",
    "qwen2.5-vl": GOLDEN / "vlm" / "qwen2_5_vl",
    "qwen3-vl": GOLDEN / "vlm" / "qwen3_vl",
    "internvl": GOLDEN / "vlm" / "internvl",
    "ovis2.5": GOLDEN / "vlm" / "ovis2_5",
}
"""By family, the folder of its tiny checkpoint and of the outputs recorded with it."""


@pytest.mark.parametrize(
    "family", [pytest.param(name, marks=() if name in FAST else pytest.mark.slow) for name in REFERENCES]
)
def test_a_family_agrees_with_the_outputs_recorded_from_the_original(family: str) -> None:
    compared = probe_kit("verify", family, REFERENCES[family], "--json").json()
    measured = [row for row in compared["comparisons"] if row["error"] is not None]
    assert len(measured) > 5
    assert [row["output"] for row in measured if not 0 <= row["error"] <= row["tolerance"]] == []
    assert any("actions" in row["output"] or "logits" in row["output"] for row in measured)


def test_every_family_that_the_package_lists_has_a_reference() -> None:
    listed = {row["model"] for row in probe_kit("models", "--json").json()}
    embedded = {name for name in listed if "-tiny" in name}
    scripted = {"expert", "expert-mirrored", "idle"}
    assert listed - embedded - scripted == set(REFERENCES)


def test_an_output_that_differs_from_the_recorded_one_is_named_and_ends_with_1(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(REFERENCES["openvla"], tmp_path / "changed"))
    with np.load(folder / "reference.npz") as recorded:
        arrays = dict(recorded)
    name = "batch_logits"
    arrays[name] = arrays[name] + np.asarray(0.01, arrays[name].dtype)
    np.savez(folder / "reference.npz", **arrays)
    answer = probe_kit("verify", "openvla", folder, code=1)
    assert name in answer.text
