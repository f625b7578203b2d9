"""`--dry-run` plans with declared sizes: no weights, no network, no GPU; words are refused before the network."""

import json
import shutil
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from torch import nn

from probe_kit.errors import CheckpointError, InstructionError, UsageError
from probe_kit.extract import AskSettings, ExtractSettings, prepare
from probe_kit.extract.extraction import prepare_asks
from probe_kit.extract.sizes import weights_needed
from probe_kit.hooks import load_model
from probe_kit.hooks.contract.sites import PADDING
from probe_kit.hooks.registry import own_families
from probe_kit.runs.plan import Plan
from probe_kit.runs.run_folders import in_units
from probe_kit.suite import Suite, build_suite, default_suite, load_suite
from probe_kit.suite.sufficiency import sufficiencies
from tests.hooks.families.pi0.checkpoints import write_intact
from tests.hooks.families.pi0.pi05_checkpoints import write_pi05
from tests.hooks.families.smolvla.checkpoints import write_smolvla
from tests.support.every_checkpoint import WRITERS, families

DECLARING = [name for name, family in own_families().items() if family.checkpoints.declared]
RELEASED = [(name, size) for name in DECLARING for size in own_families()[name].checkpoints.declared]


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No network, an empty cache of the hub; the scene is built by other tests."""

    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError("a dry run asked the network")

    monkeypatch.setattr("probe_kit.extract.sources.scene_source.SceneSource.rehearse", lambda *_: None)
    monkeypatch.setattr(socket, "create_connection", refuse)
    monkeypatch.setattr("probe_kit.hooks.checkpoints.checkpoint.urlopen", refuse)
    monkeypatch.setattr("huggingface_hub.snapshot_download", refuse)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "empty"))


def settings_of(name: str, suite: Suite, **options: Any) -> ExtractSettings | AskSettings:
    family = own_families()[name]
    kind = ExtractSettings if family.abilities.acts else AskSettings
    if family.requirements.needs_checkpoint:
        options.setdefault("checkpoint", "lab/tuned")  # of the hub, and not here
    if (
        family.abilities.acts
        and "checkpoint" not in options
        and family.default_checkpoint in family.checkpoints.not_acting
    ):
        options["capture_only"] = True
    return kind(
        name, suite=suite.folder, categories=("color",), items=2, tokens="pooled", device="cuda", **options
    )


@pytest.mark.usefixtures("nowhere")
@pytest.mark.parametrize(("name", "size"), RELEASED)
def test_a_plan_needs_no_weights_no_network_and_no_gpu(name: str, size: str, small_suite: Suite) -> None:
    options = {"size": size} if size else {}
    planned = prepare(settings_of(name, small_suite, options=options), fetch=False)
    declared = own_families()[name].checkpoints.declared[size]
    shapes = [
        (
            declaration.stream.name,
            declaration.stream.layers,
            declaration.stream.width,
            declaration.stream.iterations,
        )
        for declaration in declared
    ]
    assert [
        (stream.name, stream.layers, stream.width, stream.iterations) for stream in planned.plan.streams
    ] == shapes
    assert planned.plan.bytes > 0
    assert len(planned.plan.episodes) == 4
    assert planned.identity()["weights_sha256"] is None
    with pytest.raises(UsageError, match="planned without its model"):
        planned.run("anywhere")


@pytest.mark.parametrize(("name", "size"), RELEASED)
def test_memory_and_download_of_every_released_size_are_named(name: str, size: str) -> None:
    options = {"size": size} if size else {}
    family = own_families()[name]
    count = family.checkpoints.parameters[size]
    words = weights_needed(name, None, options, "bfloat16")
    assert f"memory {(4 if family.requirements.always_float32 else 2) * count / 1e9:,.1f} GB" in words
    assert f"or {4 * count / 1e9:,.1f} GB, as stored, estimated" in words or "nothing to download" in words
    assert weights_needed("pi0-tiny", None, {}, None) == ""


def test_a_checkpoint_in_a_folder_is_nothing_to_download(tmp_path: Path) -> None:
    words = weights_needed("pi0", str(write_intact(tmp_path / "pi0")), {}, None)
    assert words.endswith("nothing to download")


NOT_ACTING = [
    (name, checkpoint) for name, family in own_families().items() for checkpoint in family.checkpoints.not_acting
]


@pytest.mark.usefixtures("nowhere")
@pytest.mark.parametrize(("name", "checkpoint"), NOT_ACTING)
def test_a_checkpoint_that_cannot_act_here_is_planned_with_no_act_alone(
    name: str, checkpoint: str, small_suite: Suite
) -> None:
    with pytest.raises(UsageError, match="Plan and capture it with --no-act"):
        prepare(settings_of(name, small_suite, checkpoint=checkpoint), fetch=False)
    planned = prepare(settings_of(name, small_suite, checkpoint=checkpoint, capture_only=True), fetch=False)
    assert planned.plan.bytes > 0


def cached(monkeypatch: pytest.MonkeyPatch, cache: Path, repo: str, files: Path, weights: bool = False) -> str:
    """A cache of the hub that holds the files of a folder, but for weights, as one commit of `repo`."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(cache))
    repository = cache / f"models--{repo.replace('/', '--')}"
    (repository / "refs").mkdir(parents=True)
    (repository / "refs" / "main").write_text("c" * 40, encoding="utf-8")
    without = shutil.ignore_patterns(*(() if weights else ("model*.safetensors*", "*.pt")))
    shutil.copytree(files, repository / "snapshots" / ("c" * 40), ignore=without)
    return repo


def sizes(streams: Any) -> dict[str, tuple[Any, ...]]:
    return {
        stream.name: (stream.layers, stream.width, stream.iterations, stream.quantities, stream.part)
        for stream in streams
    }


@pytest.mark.slow
@pytest.mark.usefixtures("nowhere")
@pytest.mark.parametrize("name", families(DECLARING))
def test_a_checkpoint_whose_configuration_is_in_the_cache_is_planned_with_its_own_sizes(
    name: str, tmp_path: Path, small_suite: Suite, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Streams, memory and actions per inference; no weights are there, and no network is asked."""
    write, options = WRITERS[name]
    folder = write(tmp_path / "model")
    model = load_model(name, str(folder), **options)
    repo = cached(monkeypatch, tmp_path / "cache", "lab/tiny", folder)
    model_options: dict[str, Any] = {"capture_only": True} if own_families()[name].abilities.acts else {}
    settings = settings_of(name, small_suite, checkpoint=repo, options=options, **model_options)
    planned = prepare(settings, fetch=False)
    assert sizes(planned.plan.streams) == sizes(model.streams.values())
    assert planned.declared.startswith("of the checkpoint's configuration")
    network: Any = model
    weight_bytes = sum(parameter.numel() for parameter in network.network.parameters()) * 4
    words = weights_needed(name, repo, options, "float32")
    assert words.startswith(f"memory {in_units(weight_bytes)} for weights")
    assert "estimated from the parameters" in words


@pytest.mark.usefixtures("nowhere")
def test_a_folder_is_planned_with_its_own_sizes(tmp_path: Path, small_suite: Suite) -> None:
    folder = write_pi05(tmp_path / "model")
    planned = prepare(settings_of("pi05", small_suite, checkpoint=str(folder)), fetch=False)
    assert sizes(planned.plan.streams) == sizes(load_model("pi05", str(folder)).streams.values())


@pytest.mark.slow
@pytest.mark.usefixtures("nowhere")
def test_its_own_configuration_says_whether_a_checkpoint_acts_here(
    tmp_path: Path, small_suite: Suite, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A base model under any name is refused without --no-act; one whose file has a fine-tune's actions is not."""
    folder = write_pi05(tmp_path / "model")
    acting = cached(monkeypatch, tmp_path / "cache", "lerobot/pi05_base", folder)
    assert prepare(settings_of("pi05", small_suite, checkpoint=acting), fetch=False).plan.bytes > 0
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    config["output_features"]["action"]["shape"] = [32]
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    base = cached(monkeypatch, tmp_path / "cache", "lab/base", folder)
    with pytest.raises(UsageError, match=r"acts in 32 dimensions.*--no-act"):
        prepare(settings_of("pi05", small_suite, checkpoint=base), fetch=False)
    assert (
        prepare(settings_of("pi05", small_suite, checkpoint=base, capture_only=True), fetch=False).plan.bytes > 0
    )
    with pytest.raises(CheckpointError, match=r"acts in 32 dimensions.*--no-act"):
        prepare(settings_of("pi05", small_suite, checkpoint=str(folder)), fetch=False)


@pytest.mark.usefixtures("nowhere")
def test_a_configuration_whose_backbone_is_not_in_the_cache_is_planned_with_the_released_size_and_why(
    tmp_path: Path, small_suite: Suite, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_smolvla(tmp_path / "model")
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    config["vlm_model_name"] = "lab/absent"
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    repo = cached(monkeypatch, tmp_path / "cache", "lab/tiny", folder)
    planned = prepare(settings_of("smolvla", small_suite, checkpoint=repo, capture_only=True), fetch=False)
    assert planned.declared.startswith("of the released size, because its own configuration cannot be read here: ")
    assert "lab/absent" in planned.declared
    assert [stream.layers for stream in planned.plan.streams] == [17, 17]


@pytest.mark.slow
@pytest.mark.usefixtures("nowhere")
def test_an_adapter_in_the_cache_is_planned_with_the_sizes_of_its_base(
    tmp_path: Path, small_suite: Suite, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As long as the weights of either are not there, they are to be downloaded."""
    base = write_pi05(tmp_path / "base")
    streams = sizes(load_model("pi05", str(base)).streams.values())
    (tmp_path / "alone").mkdir()
    settings = {"peft_type": "LORA", "r": 2, "lora_alpha": 2, "base_model_name_or_path": "lab/base"}
    (tmp_path / "alone" / "adapter_config.json").write_text(json.dumps(settings), encoding="utf-8")
    tuned = cached(monkeypatch, tmp_path / "cache", "lab/tuned", tmp_path / "alone")
    tuned_settings = settings_of("pi05", small_suite, checkpoint=tuned, capture_only=True)
    planned = prepare(tuned_settings, fetch=False)
    assert planned.declared.startswith("of the released size, because")
    assert "'lab/base'" in planned.declared
    cached(monkeypatch, tmp_path / "cache", "lab/base", base)
    assert sizes(prepare(tuned_settings, fetch=False).plan.streams) == streams
    assert "download about" in weights_needed("pi05", tuned, {}, None)
    folder = tmp_path / "cache" / "models--lab--base" / "snapshots" / ("c" * 40)
    shutil.copy(base / "model.safetensors", folder)
    assert "download about" in weights_needed("pi05", tuned, {}, None)
    (folder.parents[2] / "models--lab--tuned" / "snapshots" / ("c" * 40) / "adapter_model.safetensors").touch()
    assert weights_needed("pi05", tuned, {}, None).endswith("nothing to download")


@pytest.mark.usefixtures("nowhere")
def test_a_download_is_counted_from_the_index_of_the_weights_in_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_pi05(tmp_path / "model")
    content = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").unlink()
    for number, part in enumerate((content[:5_000], content[5_000:7_000]), 1):
        (folder / f"model-0000{number}-of-00002.safetensors").write_bytes(part)
    index = {
        "metadata": {"total_size": 1_234_567},
        "weight_map": {"a": "model-00001-of-00002.safetensors", "b": "model-00002-of-00002.safetensors"},
    }
    (folder / "model.safetensors.index.json").write_text(json.dumps(index), encoding="utf-8")
    repo = cached(monkeypatch, tmp_path / "cache", "lab/tiny", folder, weights=True)
    assert weights_needed("pi05", repo, {}, None).endswith("nothing to download")
    (tmp_path / "cache" / "models--lab--tiny" / "snapshots" / ("c" * 40) / index["weight_map"]["b"]).unlink()
    assert weights_needed("pi05", repo, {}, None).endswith(f"download {in_units(1_234_567 - 5_000)}")


def test_every_family_of_the_hub_declares_its_sizes() -> None:
    for name, family in own_families().items():
        on_the_hub = family.default_checkpoint is not None or family.requirements.needs_checkpoint
        assert bool(family.checkpoints.declared) == on_the_hub, name
        assert family.checkpoints.parameters.keys() == family.checkpoints.declared.keys(), name
        assert family.checkpoints.sizes == () or [size for size, _ in family.checkpoints.sizes] == list(
            family.checkpoints.declared
        )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), RELEASED)
def test_declared_sizes_are_those_of_the_released_network(name: str, size: str) -> None:
    """Of every stream there is a list of so many blocks whose weights have its width; on the meta device."""
    family = own_families()[name]
    network = family.function("full_size")(*([size] if size else []))
    assert sum(parameter.numel() for parameter in network.parameters()) == family.checkpoints.parameters[size]
    lists = [
        (len(module), {side for parameter in module[0].parameters() for side in parameter.shape})
        for module in network.modules()
        if isinstance(module, nn.ModuleList) and len(module)
    ]
    for declaration in family.checkpoints.declared[size]:
        fits = [
            blocks
            for blocks, sides in lists
            if blocks == declaration.stream.layers - 1 and declaration.stream.width in sides
        ]
        assert fits, declaration


@pytest.mark.parametrize("name", families(DECLARING))
def test_declared_streams_have_the_names_and_roles_of_the_loaded_model(name: str, tmp_path: Path) -> None:
    """Of a tiny checkpoint; only sizes and the camera's name are others."""
    write, options = WRITERS[name]
    model = load_model(name, str(write(tmp_path / "model")), **options)
    declared = {
        declaration.stream.name: declaration
        for declaration in next(iter(own_families()[name].checkpoints.declared.values()))
    }
    assert declared.keys() == model.streams.keys()
    for stream in model.streams.values():
        declaration = declared[stream.name]
        assert replace(declaration.stream, layers=1, width=1, iterations=None) == replace(
            stream, layers=1, width=1, iterations=None
        )
        assert (declaration.stream.iterations is None) == (stream.iterations is None)
        declared_roles, own_roles = ({role.partition(".")[0] for role in roles} for roles in (
            declaration.roles, model.role_names[stream.name]))  # fmt: skip
        assert declared_roles == own_roles - {PADDING}


@pytest.mark.usefixtures("nowhere")
def test_questions_are_planned_without_their_model(small_suite: Suite) -> None:
    asks = [settings_of("qwen3-vl", small_suite)] * 2
    assert [prepared_ask.declared for prepared_ask in prepare_asks(asks, [None, None], fetch=False)] == [
        "of the released size"
    ] * 2  # type: ignore[arg-type]


@pytest.mark.usefixtures("nowhere")
@pytest.mark.parametrize("name", ["pi0", "magma"])
def test_a_folder_that_is_not_there_is_refused_without_the_network(name: str, small_suite: Suite) -> None:
    """Also of families whose checkpoints only their loader knows."""
    with pytest.raises(CheckpointError, match="does not exist"):
        prepare(settings_of(name, small_suite, checkpoint="./nowhere"), fetch=False)


@pytest.mark.slow
@pytest.mark.usefixtures("nowhere")
def test_a_plan_of_a_few_items_draws_these_and_one_category(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The items, their hash and what they are enough for are those of the whole suite."""
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path / "cache"))
    settings = ExtractSettings("pi05", categories=("color", "shape"), items=4, device="cuda", capture_only=True)
    first = prepare(settings, fetch=False)
    assert isinstance(first.plan, Plan)
    drawn = [len(load_suite(folder).items) for folder in (tmp_path / "cache" / "suites").iterdir()]
    assert sorted(drawn) == [8, 150]
    full_suite = default_suite(("color", "shape"))
    again = prepare(settings, fetch=False)
    assert isinstance(again.plan, Plan)
    assert again.source.suite.complete.content_sha256 == full_suite.content_sha256
    assert first.source.suite.items == again.source.suite.items
    assert first.source.suite.identity == again.source.suite.identity
    enough = [list(sufficiencies(prepared.source.suite, True, True)) for prepared in (first, again)]
    assert enough[0] == enough[1]


@pytest.mark.slow
@pytest.mark.parametrize("fetch", [True, False])
def test_words_that_a_policy_cannot_read_are_refused_before_its_network_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fetch: bool
) -> None:
    folder = write_intact(tmp_path / "pi0")
    suite = build_suite(tmp_path / "suite", ["color"], 2)
    monkeypatch.setattr("probe_kit.hooks.families.pi0.adapter.build_pi0", lambda *_: pytest.fail("it was built"))
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    config["tokenizer_max_length"] = 3
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    settings = ExtractSettings("pi0", str(folder), suite=suite.folder, options={"statistics": "bridge"})
    with pytest.raises(InstructionError, match=r"this checkpoint reads 3\. Shorten it"):
        prepare(settings, fetch=fetch)
