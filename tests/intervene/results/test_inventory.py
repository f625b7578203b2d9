"""`probe-kit run show`: every stored intervention, by its key."""

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import RunDamagedError
from probe_kit.intervene import ConceptErasure, ImageSwap, load_effects
from probe_kit.intervene.inventory import listed_interventions
from probe_kit.intervene.settings import FORMAT, key_of, settings_of
from probe_kit.intervene.stored import stored_interventions
from probe_kit.runs import Run, open_run
from probe_kit.runs.layout import INTERVENTIONS
from probe_kit.runs.results import write_bundle
from tests.intervene.answers import follower, outcomes_of, store_outcomes


@pytest.fixture
def run(little_runs: Path, tmp_path: Path) -> Run:
    return open_run(shutil.copytree(little_runs / "run", tmp_path / "run"))


def store(run: Run, intervention: ImageSwap | ConceptErasure) -> str:
    outcomes, settings = outcomes_of({"color": follower(24)}), settings_of(intervention, run)
    return store_outcomes(run.location, run.seed_text, settings, outcomes)


def printed_inventory(run: Run, *options: str) -> str:
    answer = CliRunner().invoke(app, ["run", "show", str(run.path), *options])
    assert answer.exit_code == 0, answer.stderr
    return answer.stdout if "--json" in options else " ".join(answer.stdout.split())


def test_interventions_are_listed_oldest_first_with_what_was_asked(run: Run) -> None:
    (first,) = listed_interventions(run)
    assert (first.kind, first.state, first.categories) == ("image-swap", "used", ("color",))
    more, erased = store(run, ImageSwap(items=12)), store(run, ConceptErasure(sites=("backbone.01",), controls=2))
    assert [(intervention.key, intervention.state) for intervention in listed_interventions(run)] == [
        (first.key, "other"), (more, "used"), (erased, "used"),
    ]  # fmt: skip
    text = printed_inventory(run)
    assert f"intervention {more}" in text
    assert "follow of color; 12 items each; another one stands in its place in tables; made" not in text
    assert "erase of color; controls 2; method leace; roles image; seed 0; sites backbone.01; made" in text
    assert "another one stands in its place" in text
    listed = json.loads(printed_inventory(run, "--json"))["interventions"]
    assert [record["key"] for record in listed] == [first.key, more, erased]
    assert listed[2]["parameters"]["method"] == "leace"


def test_the_inventory_marks_results_that_are_unfinished_or_of_other_episodes(run: Run) -> None:
    (first,) = listed_interventions(run)
    partial = run.path / "interventions" / ".0123456789ab.partial"
    partial.mkdir()
    (partial / "000000.npz").write_bytes(b"")
    sorted((run.path / "commits").iterdir())[-1].unlink()
    shutil.rmtree(run.path / "sealed")  # else it is a run that lost an episode
    text = printed_inventory(run)
    assert f"intervention {first.key}" in text
    assert "other episodes" in text
    assert "unfinished 0123456789ab" in text
    assert "1 item so far" in text


@pytest.mark.parametrize("stored_format", [1, FORMAT + 1, None])
def test_an_intervention_of_another_format_is_refused_by_its_name(run: Run, stored_format: int | None) -> None:
    store(run, ImageSwap(items=2))
    settings = {"format": stored_format, "kind": "follow"}
    write_bundle(run.location, INTERVENTIONS, key_of(settings), {"settings": settings})
    for read in (listed_interventions, stored_interventions, load_effects):
        with pytest.raises(RunDamagedError, match=rf"has format {stored_format}; .* reads format {FORMAT}\. "):
            read(run)
