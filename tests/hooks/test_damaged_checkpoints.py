"""A damaged checkpoint of any family is refused by name, or acts as if nothing had happened."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from probe_kit.errors import CheckpointError, MissingExtraError, ProbeKitError, WeightsError
from probe_kit.hooks.checkpoints.third_party import while_acting
from probe_kit.hooks.registry import find_family
from probe_kit.hooks.testing import example_observations
from probe_kit.models.embedded import embedded_checkpoint
from tests.support.every_checkpoint import WRITERS, families

GOLDEN = Path(__file__).parents[1] / "golden"
REFUSALS = (CheckpointError, WeightsError)


def copy_of(folder: Path) -> Callable[[Path], Path]:
    """A writer that copies a checkpoint with what lies beside it: sizes and tokenizers of golden references do."""

    def write(target: Path) -> Path:
        if not folder.is_dir():
            pytest.skip(f"no golden reference at {folder}")
        if folder.name != "checkpoint":
            return Path(shutil.copytree(folder, target / "checkpoint"))
        shutil.copytree(folder.parent, target, ignore=shutil.ignore_patterns("*.npz", "*.gz"))
        return target / "checkpoint"

    return write


FAMILIES = {
    **{name: pair for name, pair in WRITERS.items() if find_family(name).abilities.acts},
    "pi0-tiny": (copy_of(embedded_checkpoint("pi0-tiny")), {}),
    "pi0": (copy_of(GOLDEN / "pi0" / "checkpoint"), {}),  # with the statistics that others leave to an evaluation
    "groot": (copy_of(GOLDEN / "groot" / "checkpoint"), {}),  # without the base's weights, which nothing reads
}
INSTRUCTIONS = {"pi0": "the cube on the red", "smolvla": "the cube on the red"}
"""The words that the golden tokenizers know."""
WRONG = ("x", -7, 10**30, float("nan"), [], {}, None, 1e308, True, "../../x", "\ud800", [[[]]])
MOST_MEMORY = 4 << 30
pytestmark = pytest.mark.filterwarnings("ignore:the model put out tokens")  # what is damaged may say anything
COUNTS = ("num_hidden_layers", "num_layers", "depth", "chunk_size", "num_inference_steps", "num_steps")


@pytest.fixture(autouse=True)
def _bounded_memory() -> Iterator[None]:
    """A damaged file of a megabyte may fail, and may not fill the machine."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_MEMORY, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.fixture(params=families(FAMILIES))
def family(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.fixture
def checkpoint(family: str, tmp_path: Path) -> Path:
    """A checkpoint that acts, in a folder of its own with all that it needs, which a test may damage."""
    write, _ = FAMILIES[family]
    return write(tmp_path / "whole")


def load(family: str, checkpoint: Path) -> Any:
    try:
        return find_family(family).load(str(checkpoint), options=FAMILIES[family][1])
    except MissingExtraError as error:
        pytest.skip(str(error))


def act(family: str, checkpoint: Path) -> Any:
    """The actions of one inference, as an extraction asks for them."""
    model = load(family, checkpoint)
    cameras = [need.removeprefix("camera.") for need in sorted(model.card.needs) if need.startswith("camera.")]
    instruction = INSTRUCTIONS.get(family, "Put the cube on the star")
    with while_acting(family, model.card.checkpoint):
        return model.act(example_observations([instruction], cameras), [0])


def mappings(value: Any) -> Iterator[dict[str, Any]]:
    """Every object in a JSON value."""
    if isinstance(value, dict):
        yield value
    for child in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from mappings(child)


def edit_json(checkpoint: Path, change: Callable[[dict[str, Any]], bool]) -> int:
    """Let `change` loose on every object of every JSON file; how many it says it changed."""
    changed = 0
    for file in sorted(checkpoint.rglob("*.json")):
        content = json.loads(file.read_text(encoding="utf-8"))
        change_count = sum(change(mapping) for mapping in list(mappings(content)))
        if change_count:
            file.write_text(json.dumps(content), encoding="utf-8")
        changed += change_count
    return changed


def edit_tensors(
    checkpoint: Path, change: Callable[[str, torch.Tensor], torch.Tensor | None], only: str = ""
) -> int:
    """Replace tensors for which `change` gives one; how many."""
    changed = 0
    for file in sorted(checkpoint.rglob("*.safetensors")):
        tensors = load_file(file)
        new = {
            name: replacement
            for name, old in tensors.items()
            if only in name and (replacement := change(name, old)) is not None
        }
        if new:
            save_file({**tensors, **new}, file)
        changed += len(new)
    return changed


def test_every_family_of_ours_is_looked_at() -> None:
    from probe_kit.hooks.registry import own_families

    acting = {name for name, entry in own_families().items() if entry.abilities.acts}
    assert acting - {"pi0-tiny-early", "pi0-tiny-state"} == FAMILIES.keys()


@pytest.mark.parametrize(
    "kind", [torch.int8, torch.float8_e4m3fn, pytest.param(torch.complex64, marks=pytest.mark.slow)], ids=str
)
def test_weights_of_a_kind_that_nobody_declared_are_refused(
    family: str, checkpoint: Path, kind: torch.dtype
) -> None:
    changed_names: list[str] = []

    def first(name: str, old: torch.Tensor) -> torch.Tensor | None:
        if changed_names or not old.is_floating_point() or old.ndim < 2:
            return None
        changed_names.append(name)
        return old.to(kind)

    if not edit_tensors(checkpoint, first):
        pytest.skip("its weights are no safetensors")
    with pytest.raises(REFUSALS, match=r"of a kind that no model declares"):
        load(family, checkpoint)


@pytest.mark.parametrize("spoil", ["turned around", "NaN", "text"])
def test_statistics_that_would_change_what_actions_mean_are_refused(
    family: str, checkpoint: Path, spoil: str
) -> None:
    def bounds(mapping: dict[str, Any]) -> bool:
        for low, high in (("q01", "q99"), ("mean", "std")):
            if isinstance(mapping.get(low), list) and isinstance(mapping.get(high), list) and len(mapping[low]):
                worse = {
                    "turned around": (np.asarray(mapping[high]) + 1, -1 - np.abs(mapping[high])),
                    "NaN": (np.asarray(mapping[low]) * np.nan, np.asarray(mapping[high])),
                    "text": (np.full(np.shape(mapping[low]), "much"), np.asarray(mapping[high])),
                }[spoil]
                mapping[low], mapping[high] = (part.tolist() for part in worse)
                return True
        return False

    def stored(name: str, old: torch.Tensor) -> torch.Tensor | None:
        ends = name.rsplit(".", 1)[-1]
        if ends not in ("std", "max", "q99") or spoil == "text":
            return None
        return -old.abs() - 1e3 if spoil == "turned around" else old * torch.nan

    if family == "magma":
        pytest.skip("the statistics that it uses by default come with probe_kit")
    processors = list(checkpoint.glob("policy_*.safetensors"))
    if processors:
        for file in processors:
            tensors = load_file(file)
            save_file({n: t if (new := stored(n, t)) is None else new for n, t in tensors.items()}, file)
    elif not edit_json(checkpoint, bounds):
        pytest.skip("no statistics of this form")
    if processors and spoil == "text":
        pytest.skip("its statistics are tensors")
    with pytest.raises(CheckpointError):
        act(family, checkpoint)


def test_counts_without_bound_are_refused_before_anything_is_built(family: str, checkpoint: Path) -> None:
    def absurd(mapping: dict[str, Any]) -> bool:
        count_names = [name for name in COUNTS if type(mapping.get(name)) is int]
        mapping.update(dict.fromkeys(count_names, 10**12))
        return bool(count_names)

    if not edit_json(checkpoint, absurd):
        pytest.skip("its files hold no such count")
    with pytest.raises(REFUSALS):
        load(family, checkpoint)


@pytest.mark.parametrize("name", ["../elsewhere.safetensors", "/etc/passwd", "", 7, None, ["a"], "a/b"])
def test_an_index_may_only_name_files_beside_it(tmp_path: Path, name: Any) -> None:
    from probe_kit.hooks.checkpoints.checkpoint import INDEX_FILE, missing_weights
    from probe_kit.hooks.checkpoints.weights import read_weights

    (tmp_path / INDEX_FILE).write_text(json.dumps({"weight_map": {"a": name}}), encoding="utf-8")
    assert "damaged" in missing_weights(tmp_path)
    with pytest.raises(WeightsError, match="is damaged"):
        read_weights(tmp_path)


def _without_text_sizes(file: Path, *parts: str) -> None:
    """Take `text_config` from a configuration, or from a part of it."""
    part = config = json.loads(file.read_text(encoding="utf-8"))
    for name in parts:
        part = part[name]
    del part["text_config"]
    file.write_text(json.dumps(config), encoding="utf-8")


@pytest.mark.parametrize(
    ("family", "lose", "complaint"),
    [
        ("groot", lambda folder: _without_text_sizes(folder / "base" / "vlm" / "config.json"), "describes a netw"),
        ("eo1", lambda folder: _without_text_sizes(folder / "config.json", "vlm_config"), "describes a netw"),
        ("molmoact2", lambda folder: _without_text_sizes(folder / "vlm" / "config.json"), "describes a netw"),
        ("molmoact2", lambda folder: (folder / "vlm" / "config.json").unlink(), r"vlm has no config\.json"),
    ],
    ids=["groot", "eo1", "molmoact2", "molmoact2-file"],
)
def test_sizes_that_are_missing_are_named_before_a_network_of_billions_fills_the_memory(
    family: str, checkpoint: Path, lose: Callable[[Path], None], complaint: str
) -> None:
    """transformers takes the sizes of a class for those that a configuration lacks."""
    lose(checkpoint)
    with pytest.raises(CheckpointError, match=complaint):
        load(family, checkpoint)


def damage(checkpoint: Path, random: Random) -> str:
    """One accident, chosen at random; what it was."""
    file = random.choice(
        [checkpoint_file for checkpoint_file in sorted(checkpoint.rglob("*")) if checkpoint_file.is_file()]
    )
    kinds = ["cut", "flip", "unlink"] + ["deep", "other", "drop", "wrong", "wrong", "wrong"] * (
        file.suffix == ".json"
    )
    kind = random.choice(kinds)
    content = file.read_bytes()
    if kind == "cut":
        file.write_bytes(content[: random.randrange(len(content) + 1)])
    elif kind == "flip":
        at = random.randrange(min(len(content), 4096))
        file.write_bytes(content[:at] + bytes([content[at] ^ (1 << random.randrange(8))]) + content[at + 1 :])
    elif kind == "unlink":
        file.unlink()
    elif kind in ("deep", "other"):
        file.write_text(
            "[" * 99_999 if kind == "deep" else random.choice(["null", "[]", '"x"', "{}", "7"]), encoding="utf-8"
        )
    else:
        value = json.loads(content)
        objects = [mapping for mapping in mappings(value) if mapping]
        if objects:
            mapping = random.choice(objects)
            key = random.choice(sorted(mapping))
            if kind == "drop":
                del mapping[key]
            else:
                mapping[key] = random.choice(WRONG)
            file.write_text(json.dumps(value), encoding="utf-8")
    return f"{kind} {file.name}"


def check(family: str, intact: Path, folder: Path, seed: int) -> bool:
    """Whether a damaged copy was refused.

    Damage a copy, and find it refused by the names of family and folder, or acting with finite numbers.
    """
    original = folder / "whole"
    copy = Path(shutil.copytree(original, folder / str(seed))) / intact.relative_to(original)
    what = damage(copy, Random(seed))
    refusal, actions = "", np.zeros(1)
    try:
        actions = act(family, copy)
    except ProbeKitError as error:
        refusal = str(error)
    assert np.isfinite(actions).all(), (family, seed, what)
    if refusal:
        assert family in refusal.replace(str(copy), ""), (family, seed, what, refusal)
        assert str(copy) in refusal, (family, seed, what, refusal)
    shutil.rmtree(folder / str(seed))
    return bool(refusal)


@pytest.mark.slow  # a family whose sizes were damaged may build a large network before it is refused
@pytest.mark.parametrize("seed", [1, 2])
def test_any_accident_is_refused_by_name_or_harmless(
    family: str, checkpoint: Path, tmp_path: Path, seed: int
) -> None:
    check(family, checkpoint, tmp_path, seed)


@pytest.mark.slow
def test_a_hundred_accidents_of_each_family(family: str, checkpoint: Path, tmp_path: Path) -> None:
    assert np.isfinite(act(family, checkpoint)).all()
    refused = sum(check(family, checkpoint, tmp_path, seed) for seed in range(100, 200))
    print(f"{family}: {refused} of 100 refused, the others acted with finite numbers")
    assert 0 < refused < 100, "a checkpoint that never acts, or never cannot, shows nothing"
