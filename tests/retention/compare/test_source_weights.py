"""The source of a policy is a set of weights: a hash, a hub id or a size, never a family's name."""

import shutil
from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors.torch import load_file

from probe_kit.hooks import ModelCard, load_model
from probe_kit.hooks.registry import find_family, own_families
from probe_kit.models.embedded import embedded_checkpoint
from probe_kit.retention import retention_table
from probe_kit.retention.compare.models import grew_from
from probe_kit.retention.report import report_html
from tests.retention.asked_runs import SaidRun, acted, asked

GROWN = {name: family for name, family in own_families().items() if family.source_weights is not None}
RIGHT = {"color": np.random.default_rng(0).random((12, 2)) < 0.7}


def vlm(path: Path, card: ModelCard, called: str = "") -> SaidRun:
    return replace(asked(path, RIGHT, card.family, called), certificate={"policy": card.to_json()})


def policy(path: Path, card: ModelCard) -> SaidRun:
    return replace(acted(path, RIGHT, card.family), certificate={"policy": card.to_json()})


def card(family: str, checkpoint: str, parameters: int, random: bool = False) -> ModelCard:
    """As a loader fills it; `Family.load` adds what is known of the source."""
    plain = ModelCard(family, checkpoint, "0" * 64, random, parameters, "float32", "cpu", "", (), 0, 0)
    return replace(plain, **find_family(family)._source_of(plain, checkpoint))


def xiaomi(checkpoint: str | None = None, random: bool = False) -> ModelCard:
    return card("xiaomi-r0", checkpoint or str(GROWN["xiaomi-r0"].default_checkpoint), 1, random)


QWEN_4B = card("qwen3-vl", "Qwen/Qwen3-VL-4B-Instruct", 4_437_815_808)
QWEN_32B = card("qwen3-vl", "Qwen/Qwen3-VL-32B-Instruct", 33_357_000_000)
OTHERS = {
    "the same folder's size": (replace(QWEN_4B, checkpoint="my/copy"), "unknown"),
    "a folder of another size": (replace(QWEN_32B, checkpoint="my/copy"), "no"),
    "a untrained network": (replace(QWEN_4B, random_weights=True), "no"),
    "another network": (card("paligemma", "google/paligemma-3b-pt-224", 2_923_466_480), "no"),
}


def test_another_size_of_the_same_family_is_not_the_source(tmp_path: Path) -> None:
    grown = policy(tmp_path / "p", xiaomi())
    assert grew_from(grown, vlm(tmp_path, QWEN_4B)) == "yes"
    assert grew_from(grown, vlm(tmp_path, QWEN_32B)) == "no"


@pytest.mark.parametrize("name", OTHERS)
def test_what_cannot_be_told_is_unknown(tmp_path: Path, name: str) -> None:
    asked_card, expected = OTHERS[name]
    assert grew_from(policy(tmp_path / "p", xiaomi()), vlm(tmp_path, asked_card)) == expected


def test_a_checkpoint_that_is_not_the_familys_own_grew_from_unknown_weights(tmp_path: Path) -> None:
    mine = policy(tmp_path / "p", xiaomi("my/fine-tune"))
    assert grew_from(mine, vlm(tmp_path, QWEN_4B)) == "unknown"
    assert grew_from(mine, vlm(tmp_path, OTHERS["another network"][0])) == "no"
    assert grew_from(policy(tmp_path / "p", xiaomi(random=True)), vlm(tmp_path, QWEN_4B)) == "no"


def test_runs_of_before_whose_cards_hold_a_family_only_are_unknown(tmp_path: Path) -> None:
    """Their `source` is a name; a run without a certificate has an unknown source."""
    old = acted(tmp_path / "p", RIGHT, "xiaomi-r0", source="qwen3-vl")
    assert grew_from(old, vlm(tmp_path, QWEN_4B)) == "unknown"
    assert grew_from(old, asked(tmp_path / "r", RIGHT)) == "unknown"
    assert grew_from(acted(tmp_path / "p", RIGHT), vlm(tmp_path, QWEN_4B)) == "unknown"


def test_the_embedded_policies_grew_from_the_embedded_vlm_and_only_from_it(tmp_path: Path) -> None:
    own = vlm(tmp_path / "r", load_model("vlm-tiny").card)
    untrained = vlm(tmp_path / "t", load_model("vlm-tiny", random_weights=True).card)
    place = tmp_path / "copy of the VLM"
    shutil.copytree(embedded_checkpoint("vlm-tiny"), place)
    copied = vlm(tmp_path / "c", load_model("paligemma", str(place)).card)
    for name in ("pi0-tiny", "pi0-tiny-early", "pi0-tiny-state"):
        acting = policy(tmp_path / name, load_model(name).card)
        assert [grew_from(acting, one) for one in (own, untrained, copied)] == ["yes", "no", "yes"]
    assert grew_from(policy(tmp_path / "x", load_model("pi0-tiny", random_weights=True).card), own) == "no"


def test_the_early_policy_holds_the_weights_that_its_family_declares() -> None:
    """It was stored in half precision before any training."""
    there = load_file(embedded_checkpoint("pi0-tiny-early") / "model.safetensors")
    source = load_file(embedded_checkpoint("vlm-tiny") / "model.safetensors")
    prefix = "model.paligemma_with_expert.paligemma."
    shared = [name for name in source if prefix + name in there]
    assert len(shared) > 70
    assert all(torch.equal(source[name].half(), there[prefix + name].half()) for name in shared)


@pytest.mark.parametrize("name", GROWN)
def test_the_declared_source_is_a_released_size_of_its_family(name: str) -> None:
    family = GROWN[name]
    source, declared = find_family(str(family.source)), family.source_weights
    assert declared is not None
    if source.full_size is None:
        assert asdict(declared)["sha256"] == load_model(source.name).card.weights_sha256
        assert declared.parameters == load_model(source.name).card.parameters
        return
    sizes = {checkpoint: size for size, checkpoint in source.sizes} or {source.default_checkpoint: None}
    size = sizes[declared.checkpoint]
    network = source.function("full_size")(*([] if size is None else [size]))
    assert sum(parameter.numel() for parameter in network.parameters()) == declared.parameters


def test_a_policy_whose_source_was_asked_is_not_compared_with_other_weights(tmp_path: Path) -> None:
    vlms = [vlm(tmp_path / str(n), one, f"vlm {n}") for n, one in enumerate((QWEN_4B, QWEN_32B))]
    grown = policy(tmp_path / "p", xiaomi())
    found = retention_table([*vlms, grown], vlm_vla=True).vlm_vla
    assert {(gap.group, gap.source) for gap in found} == {("vlm 0", "yes")}
    assert {(gap.group, gap.source) for gap in retention_table([vlms[1], grown], vlm_vla=True).vlm_vla} == {
        ("vlm 1", "no")
    }
    unknown = vlm(tmp_path / "u", replace(QWEN_4B, checkpoint="my/copy"), "copy")
    assert {(gap.group, gap.source) for gap in retention_table([*vlms, unknown, grown], vlm_vla=True).vlm_vla} == {
        ("vlm 0", "yes"),
        ("copy", "unknown"),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("card", "words"),
    [
        (QWEN_4B, "the policy grew from these weights"),
        (QWEN_32B, "the policy did NOT grow from these weights"),
        (replace(QWEN_4B, checkpoint="my/copy"), "unknown whether the policy grew from these weights"),
    ],
)
def test_every_format_says_whether_the_vlm_is_the_source(tmp_path: Path, card: ModelCard, words: str) -> None:
    runs = [vlm(tmp_path / "r", card), policy(tmp_path / "p", xiaomi())]
    table = retention_table(runs, vlm_vla=True)
    console = Console(width=300, record=True, file=StringIO())
    console.print(table.to_rich("all"))
    pages = (table.to_markdown(), table.to_latex("all"), report_html(runs, table), console.export_text())
    assert [words in " ".join(page.split()) for page in pages] == [True] * 4
