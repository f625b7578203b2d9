from types import SimpleNamespace

import pytest

from probe_kit.errors import CheckpointError, UnknownModelError, UsageError
from probe_kit.hooks import Family, known_families, load_policy, registry


def test_an_unknown_model_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(UnknownModelError, match="Did you mean 'pi0-tiny'"):
        load_policy("pi0-tyni")


def test_the_embedded_policies_are_trained_and_differ() -> None:
    trained, early = load_policy("pi0-tiny").card, load_policy("pi0-tiny-early").card
    assert not trained.random_weights
    assert not early.random_weights
    assert trained.weights_sha256 != early.weights_sha256


def test_a_checkpoint_folder_that_is_not_there_is_refused() -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        load_policy("pi0", "./nowhere")


def test_a_third_party_family_is_found_through_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = Family("mine", "a family of my own", None, "probe_kit.hooks.families.pi0.adapter:load_pi0_tiny")
    entry = SimpleNamespace(name="mine", load=lambda: mine, dist=None, value="theirs:FAMILY")
    monkeypatch.setattr(registry, "family_entries", lambda: [entry])
    assert known_families()["mine"] is mine
    assert load_policy("mine", random_weights=True).card.random_weights


def test_a_third_party_cannot_replace_an_embedded_family(monkeypatch: pytest.MonkeyPatch) -> None:
    impostor = Family("pi0", "not pi0", None, "nowhere:nothing")
    entry = SimpleNamespace(name="pi0", load=lambda: impostor, dist=None, value="theirs:FAMILY")
    monkeypatch.setattr(registry, "family_entries", lambda: [entry])
    assert known_families()["pi0"] is not impostor


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("pi0", "backbone 19 layers, expert 19 layers x 10 iterations"),
        ("openvla", "backbone 33 layers, action 33 layers x 7 action tokens"),
        ("qwen2.5-vl", "backbone 29 layers, answer 29 layers (7B)"),
        ("pi0-tiny", "backbone 4 layers, expert 4 layers x 10 iterations"),
    ],
)
def test_streams_in_words_tell_tokens_from_iterations_and_name_the_size(name: str, words: str) -> None:
    assert known_families()[name].streams_text() == words


def test_a_family_that_cannot_be_verified_says_so() -> None:
    with pytest.raises(UsageError, match="pi0-tiny has no full-size"):
        known_families()["pi0-tiny"].function("full_size")


def test_a_family_names_the_checkpoint_that_must_be_downloaded(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    assert known_families()["pi0-tiny"].missing() == ""
    assert "juexzz/INTACT-pi0-finetune-bridge" in known_families()["pi0"].missing()


def test_everything_a_family_still_needs_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tokenizer from another repository, a configuration that is no config.json, a package of an extra."""
    monkeypatch.setattr("huggingface_hub.try_to_load_from_cache", lambda *_: None)
    families = known_families()
    for name, needed in (
        ("pi0", ("juexzz/INTACT-pi0-finetune-bridge", "google/paligemma-3b-pt-224")),
        ("smolvla", ("lerobot/smolvla_base", "HuggingFaceTB/SmolVLM2-500M-Video-Instruct")),
        ("internvla-m1", ("InternRobotics/InternVLA-M1-Pretrain-RT-1-Bridge", "Qwen/Qwen2.5-VL-3B-Instruct")),
        ("xiaomi-r0", ("XiaomiRobotics/Xiaomi-Robotics-0-SimplerEnv-WidowX",)),
    ):
        assert families[name].missing() == f"download of {', '.join(needed)}"
    monkeypatch.setattr("probe_kit.hooks.family.find_spec", lambda _: None)
    released, *towers_and_text = families["prismatic"].missing().split(", ")
    assert released == "extra openvla and download of TRI-ML/prismatic-vlms/prism-dinosiglip-224px+7b"
    assert [name.partition("/")[0] for name in towers_and_text] == ["timm", "timm", "openvla"]
    assert families["magma"].missing() == "extra magma and download of microsoft/Magma-8B"
    hub_file = ("InternRobotics/InternVLA-M1-Pretrain-RT-1-Bridge", "config.yaml")
    monkeypatch.setattr(
        "huggingface_hub.try_to_load_from_cache", lambda *request: "x" if request == hub_file else None
    )
    assert families["internvla-m1"].missing() == "download of Qwen/Qwen2.5-VL-3B-Instruct"


def test_the_seven_models_of_the_papers_tables_can_be_loaded_by_name() -> None:
    acting = {name for name, family in known_families().items() if family.abilities.acts}
    assert acting >= {"pi0", "smolvla", "openvla", "spatialvla", "magma", "xiaomi-r0", "internvla-m1"}


@pytest.mark.parametrize(
    "error", [ImportError("no module named old"), SystemExit(1), UsageError("options have a type")]
)
def test_a_third_partys_family_that_breaks_is_named_and_takes_no_other_with_it(
    monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def load() -> Family:
        raise error

    entry = SimpleNamespace(load=load, name="broken", value="theirs:FAMILY", dist=None)
    monkeypatch.setattr(registry, "family_entries", lambda: [entry])
    with pytest.warns(registry.BrokenFamilyWarning, match=f"'broken'.*{type(error).__name__}"):
        families = known_families()
    assert "pi0-tiny" in families
    assert "broken" not in families
    with pytest.raises(UnknownModelError, match=f"'broken'.*{type(error).__name__}"):
        load_policy("broken")


def test_an_entry_point_that_is_no_family_is_refused_by_its_type(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = SimpleNamespace(load=lambda: "pi0", name="text", value="theirs:NAME", dist=None)
    monkeypatch.setattr(registry, "family_entries", lambda: [entry])
    with pytest.warns(registry.BrokenFamilyWarning, match="it is a str, not a probe_kit.hooks.Family"):
        known_families()


def test_a_family_has_the_name_of_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = Family("mine", "a family of my own", None, "nowhere:nothing")
    entry = SimpleNamespace(name="other", load=lambda: mine, value="theirs:FAMILY", dist=None)
    monkeypatch.setattr(registry, "family_entries", lambda: [entry])
    with pytest.raises(UnknownModelError, match="'mine' and its entry point 'other'"):
        load_policy("other")


def test_no_third_party_is_imported_until_its_family_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def load() -> Family:
        raise AssertionError("imported")

    entry = SimpleNamespace(name="theirs", load=load, value="theirs:FAMILY", dist=None)
    monkeypatch.setattr(registry, "family_entries", lambda: [entry])
    assert registry.get_family("pi0") is not None
    assert registry.get_family("expert") is None
    assert registry.third_party_families() == {"theirs": "theirs:FAMILY"}
    with pytest.raises(UnknownModelError, match=r"known: .*theirs"):
        load_policy("nowhere")
