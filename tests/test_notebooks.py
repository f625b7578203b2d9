"""The notebooks run from top to bottom, say what is so, and carry nothing of the machine they were made on."""

import json
import re
from importlib.util import find_spec
from pathlib import Path

import nbformat
import pytest
from nbformat import NotebookNode

from notebooks.execute import FOLDER, executed, kernel, notebooks
from probe_kit.intervene import stored_site_effects
from probe_kit.retention import retention_table
from probe_kit.runs import compare_actions, open_run
from probe_kit.train import load_results

NAMES = (
    "01-first-run", "02-layer-curves", "03-compare-models", "04-your-own-model", "05-your-own-questions",
    "06-vlm-against-vla", "07-from-readable-to-used", "08-your-own-labels", "09-your-own-recordings",
    "10-why-does-my-policy-ignore-me", "11-a-policy-server",
)  # fmt: skip
EXTRAS = {
    **dict.fromkeys(("09-your-own-recordings", "10-why-does-my-policy-ignore-me"), ("datasets", "av")),
    "11-a-policy-server": ("websockets", "msgpack"),
}
"""Modules of extras that a notebook needs; the tenth reads the recordings of the ninth."""
MACHINE = re.compile(r"/(?:home|root|tmp|Users|usr|opt|work|private|var)/|site-packages|[A-Z]:\\\\")

PICTURE = re.compile(r"(?:\.plot\(\)|^pk\.layer_curve\(.*\)|^Image\.open\(.*\)|^color|^sheet);?$", re.MULTILINE)
"""How a cell ends that is there to show a picture; a semicolon would hide it where no backend is inline."""


@pytest.fixture(scope="module")
def executed_notebooks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, NotebookNode]]:
    """The folder in which all notebooks ran, and the notebooks with fresh outputs."""
    folder = tmp_path_factory.mktemp("notebooks")
    names = [name for name in NAMES if not absent(name)]
    with kernel(folder) as manager:
        return folder, {name: executed(FOLDER / f"{name}.ipynb", folder, manager) for name in names}


def absent(name: str) -> list[str]:
    """Modules that a notebook needs and that are not installed."""
    return [module for module in EXTRAS.get(name, ()) if find_spec(module) is None]


def printed(notebook: NotebookNode) -> str:
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    return "\n".join(output.text for output in outputs if output.output_type == "stream")


def kinds(notebook: NotebookNode) -> list[list[tuple[str, tuple[str, ...]]]]:
    """Per code cell, what its outputs are: text, tables, pictures."""
    return [
        [(output.output_type, tuple(sorted(output.get("data", {})))) for output in cell.outputs]
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


def test_these_are_all_notebooks() -> None:
    assert tuple(path.stem for path in notebooks()) == NAMES


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs_and_its_committed_outputs_are_those_of_its_cells(
    name: str, executed_notebooks: tuple[Path, dict[str, NotebookNode]]
) -> None:
    if missing := absent(name):
        pytest.skip(f"{', '.join(missing)} of the extra `datasets` is not installed")
    committed = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    assert any(outputs for outputs in kinds(committed))
    assert kinds(executed_notebooks[1][name]) == kinds(committed)


@pytest.mark.slow
def test_what_the_first_notebook_says_of_the_embedded_policy_is_so(
    executed_notebooks: tuple[Path, dict[str, NotebookNode]],
) -> None:
    run = open_run(executed_notebooks[0] / "work" / "runs" / "pi0-tiny")
    assert not run.random_weights
    first = min((run.path / "probes").iterdir(), key=lambda folder: load_results(run, folder.name).created)
    rows = {row.category: row for row in retention_table([run], keys=[first.name]).rows}
    assert rows["color"].success.sr > 0.5 + (rows["color"].success.chance_margin_episodes or 1)
    assert rows["color"].retention.defined


@pytest.mark.slow
def test_the_untrained_network_is_marked_and_shows_no_signal(
    executed_notebooks: tuple[Path, dict[str, NotebookNode]],
) -> None:
    run = open_run(executed_notebooks[0] / "work" / "runs" / "pi0-tiny-random")
    assert run.random_weights
    assert not any(row.retention.defined for row in retention_table([run]).rows)


@pytest.mark.slow
def test_the_adapter_of_the_fourth_notebook_passes_its_contract(
    executed_notebooks: tuple[Path, dict[str, NotebookNode]],
) -> None:
    output = printed(executed_notebooks[1]["04-your-own-model"])
    assert re.search(r"\b[1-9][0-9] passed", output)
    assert "failed" not in output.lower()
    assert "SiteNeverFiredError" in output
    assert open_run(executed_notebooks[0] / "work" / "runs" / "tiny-vla").certificate["hooks_on_equals_hooks_off"]


@pytest.mark.slow
def test_the_questions_of_the_fifth_notebook_are_valid_and_answered(
    executed_notebooks: tuple[Path, dict[str, NotebookNode]],
) -> None:
    output = printed(executed_notebooks[1]["05-your-own-questions"])
    assert "0 errors" in output
    assert "InstructionError" in output
    assert len(open_run(executed_notebooks[0] / "work" / "runs" / "blots").episodes) == 24


@pytest.mark.slow
def test_the_vlms_of_the_sixth_notebook_are_what_it_says(
    executed_notebooks: tuple[Path, dict[str, NotebookNode]],
) -> None:
    runs = [
        open_run(executed_notebooks[0] / "work" / "runs" / name)
        for name in ("vlm-tiny", "habit", "pi0-tiny-asked")
    ]
    answer_run, habit, acted = runs
    assert (habit.episodes["side_placed"] == "left").all()
    assert retention_table([habit]).rows[0].success.sr == 0.5
    assert (answer_run.episodes["outcome"] == "correct").mean() > 0.75
    assert answer_run.episodes["first_frame_sha256"].tolist() == acted.episodes["first_frame_sha256"].tolist()


@pytest.mark.slow
def test_the_last_layer_of_the_seventh_notebook_is_read_by_nothing(
    executed_notebooks: tuple[Path, dict[str, NotebookNode]],
) -> None:
    """Its hooks fired and moved tokens; what can be read there turns nothing."""
    rows = stored_site_effects(open_run(executed_notebooks[0] / "work" / "runs" / "pi0-tiny"))["color"]
    (last,) = (row for row in rows if (row.sites, row.role) == ("backbone.03", "all"))
    assert (last.max_action_change, last.no_op_fires) == (0.0, 0)
    assert last.fires == last.n_episodes
    assert last.relative_change > 0


@pytest.mark.slow
def test_the_recordings_of_the_ninth_notebook_are_shown_and_their_side_is_decoded(
    executed_notebooks: tuple[Path, dict[str, NotebookNode]],
) -> None:
    if missing := absent("09-your-own-recordings"):
        pytest.skip(f"{', '.join(missing)} of the extra `datasets` is not installed")
    run = open_run(executed_notebooks[0] / "work" / "runs" / "recorded")
    assert run.recorded
    assert compare_actions(run).by_number.set_index("number").loc[["x", "y"], "first"].max() < 0.6
    (stored,) = (path.name for path in (run.path / "probes").iterdir())
    assert load_results(run, stored).scores["score"].max() > 0.9


@pytest.mark.parametrize("name", NAMES)
def test_every_cell_that_ends_in_a_figure_shows_a_picture(name: str) -> None:
    """In the committed outputs, which are of the same kinds as fresh ones."""
    cells = [
        c
        for c in json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
        if c["cell_type"] == "code"
    ]
    drawing = [cell for cell in cells if PICTURE.search("".join(cell["source"]).rstrip().splitlines()[-1])]
    assert drawing
    for cell in drawing:
        output_kinds = [kind for output in cell["outputs"] for kind in output.get("data", {})]
        assert "image/png" in output_kinds, cell["source"][-1]


@pytest.mark.parametrize("name", NAMES)
def test_committed_outputs_hold_no_path_of_a_machine_and_no_error(name: str) -> None:
    for cell in json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]:
        for output in cell.get("outputs", []):
            assert output["output_type"] != "error"
            texts = {kind: content for kind, content in output.get("data", {}).items() if kind != "image/png"}
            assert not MACHINE.search(json.dumps([output.get("text"), texts]))


def test_all_notebooks_together_are_small() -> None:
    assert sum(path.stat().st_size for path in notebooks()) < 2_000_000
