"""A table says which probes it is made of, and everything that is drawn of it draws these."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from probe_kit.errors import UsageError
from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.displays import collect_figures
from probe_kit.retention.report import report_html
from probe_kit.train import ArrayRun, ProbeResults, load_results, save_results
from probe_kit.train.results.probe_results import ProbeSettings

ProbedRun = Callable[..., ArrayRun]
SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7]])


def probed_again(run: ArrayRun, **changes: object) -> ProbeResults:
    """The same decisions, stored as those of other settings, and newest."""
    results = load_results(run)
    settings: ProbeSettings = replace(results.settings, **changes)  # type: ignore[arg-type]
    other = ProbeResults(settings, results.curves)
    save_results(other, run.path)
    return other


def test_figures_and_report_draw_the_probes_of_the_table_not_the_newest(probed_run: ProbedRun) -> None:
    run = probed_run({"color": SIGNAL})
    older = load_results(run)
    newer = probed_again(run, permutations=50)
    table = retention_table([run], keys=[older.key])
    assert table.results_of(run.location).key == older.key
    assert {row.run.probes for row in table.all_rows} == {older.key}
    (curves,) = [exhibit for exhibit in collect_figures([run], table) if exhibit.name.endswith("layer-curves")]
    with curves.drawn() as figure:
        assert older.key in figure.get_supxlabel()
    page = report_html([run], table)
    assert older.key in page
    assert newer.key not in page
    assert retention_table([run]).results_of(run.location).key == newer.key


def test_a_table_is_not_drawn_with_runs_it_was_not_made_of(probed_run: ProbedRun) -> None:
    table = retention_table([probed_run({"color": SIGNAL}, "one")])
    with pytest.raises(UsageError, match=r"no rows of .*other"):
        collect_figures([probed_run({"color": SIGNAL}, "other")], table)


def test_a_run_given_twice_is_refused(probed_run: ProbedRun) -> None:
    run = probed_run({"color": SIGNAL})
    for doubled in ([run, run], {"a": [run], "b": [run]}):
        with pytest.raises(UsageError, match="given twice"):
            retention_table(doubled)  # type: ignore[arg-type]


def test_a_table_without_probes_says_in_one_line_what_is_missing(probed_run: ProbedRun) -> None:
    probed = probed_run({"color": SIGNAL})
    bare = replace(probed, path=probed.path.parent / "bare")
    scripted = replace(bare, path=probed.path.parent / "scripted", model="expert", features={})
    table = retention_table([probed, bare, scripted])
    assert len(table.notes) == 2
    assert f"Run `probe-kit train {bare.path}`." in table.notes[0]
    assert "of 'expert' no stream was stored" in table.notes[1]
    assert table.rows[1].success.sr == 0.6
    assert retention_table([probed]).notes == ()


def test_a_run_of_too_few_groups_is_not_sent_to_train_which_refuses_it(probed_run: ProbedRun) -> None:
    probed = probed_run({"color": SIGNAL, "shape": SIGNAL})
    episodes = probed.episodes.copy()
    for lacking, said in (
        (
            {"color"},
            "color has 2. Extract more items. `probe-kit train PLACE --categories shape` probes the others.",
        ),
        ({"color", "shape"}, "color has 2, shape has 2. Extract more items."),
    ):
        numbers = episodes["item_id"].astype("category").cat.codes
        kinds = numbers.where(~episodes["category"].isin(lacking), numbers % 2)
        groups = kinds.astype(str) + episodes["category"]
        few = replace(probed, path=probed.path.parent / "few", episodes=episodes.assign(group_id=groups))
        (note,) = retention_table([few]).notes
        place = said.replace("PLACE", str(few.path))
        assert note.endswith(f"Probes need 5 independent groups of items: {place}")


MIXTURES = {
    "permutations": (50, "label permutations 99 (one) against 50 (other)"),
    "seed": (3, "seeds 0 (one) against 3 (other)"),
    "target": ("side.chosen", "targets side.correct (one) against side.chosen (other)"),
}


FIRST, *OTHERS = MIXTURES


@pytest.mark.slow
@pytest.mark.parametrize("name", [FIRST, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)])
def test_rows_of_other_settings_are_pointed_out_in_every_format(probed_run: ProbedRun, name: str) -> None:
    value, words = MIXTURES[name]
    one, other = (probed_run({"color": SIGNAL}, model) for model in ("one", "other"))
    assert retention_table([one, other]).notes == ()
    key = probed_again(other, **{name: value}).key
    table = retention_table([one, other], keys=[None, key])
    assert words in table.notes[-1]
    for text in (table.to_markdown(), table.to_latex("all"), as_text(table), report_html([one, other], table)):
        assert words in " ".join(text.split())


def as_text(table: RetentionTable) -> str:
    import io

    from rich.console import Console

    console = Console(width=80, file=io.StringIO())
    console.print(table.to_rich("all"))
    return console.file.getvalue()  # type: ignore[attr-defined,no-any-return]
