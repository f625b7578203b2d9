"""A kind is one file: help, options, results and lists are made from it alone."""

import importlib
import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import get_args

import pytest
import typer
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.hooks import Site
from probe_kit.hooks.contract.declared import InterventionKind, asked_as
from probe_kit.intervene import commands, kinds, load_effects
from probe_kit.intervene.inventory import listed_interventions
from probe_kit.intervene.kinds import every_kind, kind_names, kind_of
from probe_kit.intervene.kinds.base import Intervention
from probe_kit.intervene.places import TILE_ROLES
from probe_kit.retention import retention_table
from probe_kit.runs import Run
from probe_kit.suite import Suite

NAME = "dimmed-images"


@pytest.fixture
def with_entry(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[ModuleType]:
    """The command with the file that CONTRIBUTING adds, registered as a package of its own does it."""
    page = (Path(__file__).parents[3] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    file = page.partition("## To add a kind of intervention\n")[2].partition("```python\n")[2].partition("```")[0]
    (tmp_path / "dimmed_images.py").write_text(file, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    # Without the example, should the package hold it.
    monkeypatch.setattr(kinds, "_HOMES", {name: home for name, home in kinds._HOMES.items() if name != NAME})
    kinds.register(NAME, "dimmed_images")
    yield importlib.reload(commands)
    monkeypatch.undo()
    importlib.reload(commands)


def invoke(module: ModuleType, *arguments: str) -> tuple[int, str, str]:
    command = typer.Typer()
    command.command(cls=module.KindHelp)(module.intervene)
    answer = CliRunner().invoke(command, arguments, env={"COLUMNS": "200"})
    return answer.exit_code, answer.stdout, answer.stderr


def test_a_kind_of_its_own_runs_from_the_command_to_the_tables(
    with_entry: ModuleType, copy: Run, small_suite: Suite
) -> None:
    before = retention_table([copy]).to_json()
    options = ("--kind", NAME, "--categories", "color", "--items", "1", "--coefficients", "0,1")
    where = (str(copy.path), "--suite", str(small_suite.folder))
    code, output, message = invoke(with_entry, *where, *options)
    assert code == 0, message
    assert "Is the image read?" in output
    result = load_effects(copy, kind=NAME)
    dark, same = result.effects
    assert (same.condition, same.median_displacement) == ("dimmed-1", 0.0)
    assert dark.median_displacement > 0
    stored = (copy.path / "interventions" / result.key / "effects.csv").read_text(encoding="utf-8")
    assert stored.splitlines()[0] == "category,condition,n_episodes,median_displacement"
    code, output, message = invoke(with_entry, str(copy.path), *options, "--format", "json")
    assert [row["condition"] for row in json.loads(output)["effects"]] == ["dimmed-0", "dimmed-1"]
    assert json.loads(output)["effects"][0]["median_displacement"] == pytest.approx(dark.median_displacement)
    assert "loaded the stored result" in message
    assert [(listed_result.kind, listed_result.state) for listed_result in listed_interventions(copy)] == [
        (NAME, "used")
    ]
    assert retention_table([copy]).to_json() == before


def test_help_names_every_kind_and_what_its_options_mean_to_it(with_entry: ModuleType) -> None:
    code, output, _ = invoke(with_entry, "--help-all")
    assert code == 0
    words = " ".join(output.replace("│", " ").split())
    for kind in every_kind():
        assert f"--kind {kind.kind}" in words
        assert kind.summary in words
        for option, meaning in kind.options.items():
            assert f"--{option.replace('_', '-')}: {meaning}" in words


def test_an_option_of_another_kind_is_refused_with_the_kinds_that_take_it(
    with_entry: ModuleType, copy: Run
) -> None:
    code, _, _ = invoke(with_entry, str(copy.path), "--kind", NAME, "--coefficients", "1", "--sites", "kv.*")
    assert code == 1
    answer = CliRunner().invoke(app, ["intervene", str(copy.path), "--kind", "erase", "--target-side", "left"])
    assert answer.exit_code == 2
    message = " ".join(answer.stderr.split())
    assert "--target-side does not apply to --kind erase; remove it or choose another kind: steer" in message


def test_an_option_that_the_command_lacks_is_refused_where_a_kind_is_defined() -> None:
    with pytest.raises(UsageError, match=r"Misspelt declares the option 'site'.*expected some of sites, roles"):
        type("Misspelt", (Intervention,), {"options": {"site": "where"}})


def test_a_kind_of_another_package_is_listed_with_the_models_that_support_it(with_entry: ModuleType) -> None:
    assert with_entry.kind_names()[-1] == NAME
    assert NAME in asked_as("swap")[1]


@pytest.mark.parametrize("name", kind_names())
def test_every_file_holds_the_kind_that_it_is_called_after(name: str) -> None:
    kind = kind_of(name)
    assert kind.kind == name
    assert kind.summary.endswith((".", "?"))


def test_what_a_family_supports_is_listed_in_the_words_of_the_command() -> None:
    """`probe-kit models NAME` prints `--kind`, `--sites` and `--roles` as `probe-kit intervene` takes them."""
    option: dict[str, list[str]] = {"--kind": [], "--sites": [], "--roles": []}
    for capability in get_args(InterventionKind):
        name, values = asked_as(capability)
        option[name] += values
    assert sorted(option["--kind"]) == sorted(kind_names())
    assert option["--roles"] == list(TILE_ROLES)
    assert [Site.parse(f"{site.removesuffix('*')}02.keys").stream for site in option["--sites"]] == ["kv"]
    page = CliRunner().invoke(app, ["models", "internvla-m1"]).stdout
    listed = page.partition("intervene  --kind ")[2].partition(";")[0].partition("\n")[0].split(", ")
    supported = ["image-swap", "instruction-swap", "interchange", "joint", "steer", "closed-loop", "erase"]
    assert [name for name in listed if name in {*supported, "attribution", "attention"}] == supported
    assert "kv.*" not in page
    assert "; --sites kv.*" in CliRunner().invoke(app, ["models", "pi0-tiny"]).stdout
