"""How our objects and figures show themselves in a kernel, with and without an inline backend."""

import re
import shutil
from pathlib import Path

import nbformat
import pytest
from IPython.core.formatters import DisplayFormatter
from nbclient import NotebookClient
from nbformat import NotebookNode

from probe_kit._terminal.notebook import PROGRESS_MARK, facts_html, notebook_progress
from probe_kit.hooks import capture, load_policy
from probe_kit.hooks.testing import example_observations
from probe_kit.runs import Run, open_run
from probe_kit.train import ProbeResults, train_probes

INLINE = "module://matplotlib_inline.backend_inline"


@pytest.fixture(scope="module")
def probed(trainable_run: Run, tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, ProbeResults]:
    """Probes of a copy of the recorded run, so that other tests find theirs the newest."""
    copy = shutil.copytree(trainable_run.path, tmp_path_factory.mktemp("probed") / "run")
    run = open_run(copy)
    return run, train_probes(run, ["color"], permutations=20, controls=())


def run_cells(sources: list[str], folder: Path) -> list[NotebookNode]:
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in sources])
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(folder)}}).execute()
    return list(notebook.cells)


def kinds(cell: NotebookNode) -> list[str]:
    return [kind for output in cell.outputs for kind in output.get("data", {})]


FIGURES = {
    "layer_curve": "pk.layer_curve(results)",
    "display": "pk.LayerCurveDisplay.from_results(results, 'color').plot()",
    "knowledge and action": "pk.KnowledgeActionDisplay.from_table(table).plot()",
    "model depths": "model_depths([results])",
    "final positions": "pk.FinalPositionsDisplay.from_run(run).plot()",
    "layer_curve, after pyplot came in": "pk.layer_curve(results)",
}
OBJECTS = ("run", "results", "table")
WITHOUT_WIDGETS = "import sys\nsys.modules['ipywidgets'] = None\nfrom tqdm.auto import tqdm"
"""What transformers does where ipywidgets is not installed."""
FITTING = "fitted = pk.train_probes(run, ['shape'], permutations=0, seed=11, controls=())"


@pytest.fixture(scope="module")
def executed_cells(
    request: pytest.FixtureRequest, probed: tuple[Run, ProbeResults], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, NotebookNode]:
    """The cells of a notebook that shows everything, by what they show; the parameter is matplotlib's backend."""
    run, results = probed
    loading = (
        f"import probe_kit as pk\nrun = pk.open_run({str(run.path)!r})\n"
        f"results = pk.load_results(run, {results.key!r})\ntable = pk.retention_table([run], keys=[results.key])\n"
        "from probe_kit.retention.displays import model_depths"
    )
    cells = {"loading": loading, **FIGURES}
    if request.param == INLINE:
        cells |= {**{name: name for name in OBJECTS}, "fit": FITTING, "read": FITTING, "tqdm": WITHOUT_WIDGETS}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MPLBACKEND", request.param)
        executed = run_cells(list(cells.values()), tmp_path_factory.mktemp("kernel"))
    return dict(zip(cells, executed, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(
    "executed_cells", [INLINE, pytest.param("agg", marks=pytest.mark.slow)], indirect=True, ids=["inline", "agg"]
)
def test_every_figure_is_one_picture_whatever_the_backend(executed_cells: dict[str, NotebookNode]) -> None:
    pictures = {name: kinds(executed_cells[name]).count("image/png") for name in FIGURES}
    assert pictures == dict.fromkeys(FIGURES, 1)


def assert_short(name: str, data: dict[str, str]) -> None:
    text, html = data["text/plain"], data["text/html"]
    assert len(text) < 300, name
    assert text.startswith("<"), name
    assert "<table" in html, name


def test_a_policy_and_a_tape_show_short_tables_and_short_lines() -> None:
    """By what a kernel asks, without the seconds in which one imports a policy's libraries."""
    policy = load_policy("pi0-tiny")
    with capture(policy, policy.sites()) as activations:
        policy.act(example_observations(["Put the cube on the red shape"]), [0])
    for name, subject in {"policy": policy, "activations": activations}.items():
        assert_short(name, DisplayFormatter().format(subject)[0])


@pytest.mark.slow
@pytest.mark.parametrize("executed_cells", [INLINE], indirect=True, ids=["inline"])
def test_objects_show_short_tables_and_short_lines(executed_cells: dict[str, NotebookNode]) -> None:
    for name in OBJECTS:
        (output,) = executed_cells[name].outputs
        assert_short(name, output.data)
    table = executed_cells["table"].outputs[0].data["text/html"]
    assert re.search(r"background:#[0-9A-Fa-f]{6}", table)
    assert "random weights" in table


@pytest.mark.slow
@pytest.mark.parametrize("executed_cells", [INLINE], indirect=True, ids=["inline"])
def test_a_notebook_draws_one_bar_while_it_works_and_none_for_what_is_read_back(
    executed_cells: dict[str, NotebookNode],
) -> None:
    (bar,) = [output for output in executed_cells["fit"].outputs if output.output_type == "display_data"]
    assert PROGRESS_MARK in bar.data["text/html"]
    assert re.search(r"sites probed: 44 of 44, \d+ s", bar.data["text/html"])
    assert bar.data["text/plain"] == "", "a stored notebook holds a time of this machine"
    assert executed_cells["read"].outputs == []


@pytest.mark.slow
@pytest.mark.parametrize("executed_cells", [INLINE], indirect=True, ids=["inline"])
def test_a_notebook_without_ipywidgets_shows_no_warning_of_tqdm(executed_cells: dict[str, NotebookNode]) -> None:
    assert executed_cells["tqdm"].outputs == []


def test_nothing_is_drawn_outside_notebooks() -> None:
    assert notebook_progress("episodes") is None


def test_facts_are_escaped_and_empty_ones_left_out() -> None:
    html = facts_html("a < b", {"one": "<script>", "two": ""}, "note & more")
    assert "a &lt; b" in html
    assert "&lt;script&gt;" in html
    assert "two" not in html
    assert "note &amp; more" in html
