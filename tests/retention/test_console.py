import io
from collections.abc import Callable

from rich.console import Console

from probe_kit.retention import RetentionTable, retention
from probe_kit.train import ArrayRun

ProbedRun = Callable[..., ArrayRun]
SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7]])
NONE = ([0.5, 0.55, 0.5], [[0.58, 0.5]])


def printed(table: RetentionTable) -> str:
    console = Console(width=80, file=io.StringIO())
    console.print(table.to_rich())
    return console.file.getvalue()  # type: ignore[attr-defined,no-any-return]


def test_eighty_columns_suffice(probed_run: ProbedRun) -> None:
    text = printed(retention([probed_run({"facial_emotion": SIGNAL, "color": NONE})]))
    assert "…" not in text
    for cell in ("60.0 [", "knowledge", "90.0 @0.50", "70.0 @1.00/0", "0.49 [", "n/a"):
        assert cell in text


def test_every_title_marks_random_weights(probed_run: ProbedRun) -> None:
    text = printed(retention([probed_run({"color": SIGNAL}, "pi0-tiny", random_weights=True)]))
    assert text.count("pi0-tiny (random weights) on") == 2


def test_the_caption_says_why_retention_is_missing(probed_run: ProbedRun) -> None:
    text = printed(retention([probed_run({"color": SIGNAL, "counting": NONE})]))
    assert "n/a (no backbone signal)" in " ".join(text.split())
    assert "without counting" in " ".join(text.split())


def test_every_run_has_its_own_block(probed_run: ProbedRun) -> None:
    text = printed(retention([probed_run({"color": SIGNAL}, "pi0"), probed_run({"color": SIGNAL}, "smolvla")]))
    assert text.index("Success rate: pi0 ") < text.index("Retention, view mean: pi0 ")
    assert text.index("Retention, view mean: pi0 ") < text.index("Success rate: smolvla ")


def test_a_policy_without_an_expert_says_action_beside_one_that_has_one(probed_run: ProbedRun) -> None:
    runs = [probed_run({"color": SIGNAL}, "openvla", action_stream="action"), probed_run({"color": SIGNAL}, "pi0")]
    table = retention(runs)
    assert [row.action_stream for row in (*table.rows, *table.means)] == ["action", "expert"] * 2
    assert [row.retention for row in table.rows] == [table.rows[0].retention] * 2 != [None, None]
    headings = [line.split() for line in printed(table).splitlines() if "backbone" in line]
    assert [words[3] for words in headings] == ["action", "expert"]
