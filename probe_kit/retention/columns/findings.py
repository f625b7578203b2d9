"""The end of a command: a short sentence per category that says where the answer is lost, and the next step.

A sentence has at most 25 words, two numbers and no brackets. Intervals, reasons and controls stand in the table,
in `--details`, in reports and in JSON; `probe_kit.retention.columns.sentences` has the long form.
"""

import re
import shlex
from collections.abc import Sequence

from probe_kit._tables.numbers import whole_percent
from probe_kit.intervene.results.verdict import UseVerdict, more_groups
from probe_kit.retention.behaviour.success_rate import Regime
from probe_kit.retention.columns.label_sentences import label_finding
from probe_kit.retention.columns.sentences import is_probed, knows, more_items, unprobed
from probe_kit.retention.columns.text import is_vlm
from probe_kit.retention.rows.parts import StreamPart
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.statistics.label_permutations import permutations_for
from probe_kit.statistics.sufficiency import probe_command
from probe_kit.train.results.control_scores import RANDOM_FEATURES, UNTRAINED

MOST_WORDS = 25
"""Of a sentence with the name of its category, as in all texts of the package; a number is a word."""
MOST_NUMBERS = 2
"""Of a sentence; the rest stands in tables."""
_CONTROLS = {RANDOM_FEATURES: "random features", UNTRAINED: "an untrained network"}


def finding(row: RetentionRow, vlm: RetentionRow | None = None) -> str:
    """Return what is found in a category: a verdict, a colon, and where on the way to the action it is lost.

    vlm: the row of a VLM that answered the same questions.
    """
    if not row.is_side:
        return label_finding(row)
    if is_vlm(row):
        return _of_vlm(row)
    use = row.image_swap.use
    if use is None:
        return _without_swap(row, vlm)
    if use.is_bounded and is_probed(row) and not _is_encoded(row):
        return f"{_without_signal(row, vlm)}: {_unread(row)}; the action does not follow it."
    return _of_use(row, vlm, use)


def count_words(sentence: str) -> int:
    """Return the number of words and numbers."""
    return len(re.findall(r"[\w’'-]+", sentence))


# -- VLMs ----------------------------------------------------------------------------------------------------


def _of_vlm(row: RetentionRow) -> str:
    rate = f"{whole_percent(row.success.sr)} %"
    if knows(row):
        inside = ", and probes read it in the backbone" if _is_encoded(row) else ""
        return f"known: the VLM answers right in {rate}{inside}."
    if (row.success.share_outside or 0) > 0.5:
        return (
            f"not shown: no answer could be read in {whole_percent(row.success.share_outside)} % of the episodes."
        )
    inside = ", yet probes read the answer in the backbone" if _is_encoded(row) else ""
    return f"not shown: the VLM answers right in {rate}, {_against_guessing(row)}{inside}."


def _against_guessing(row: RetentionRow) -> str:
    return "less often than guessing" if row.success.regime == Regime.FAILURE else "which guessing can reach"


# -- policies ----------------------------------------------------------------------------------------------------


def _sentence(head: str, *clauses: str, row: RetentionRow) -> str:
    """Return head and clauses, with the action stream and the rate of guessing where there is room for them."""
    *before, success = [*clauses, _success(row)]
    guessing = "" if row.success.sr is None else _beside_guessing(row)
    stream = _in_action(row)
    # From most to least said: the first that is short enough.
    for in_action, guess in ((stream, guessing), (stream, ""), ("", guessing), ("", "")):
        clauses_of = [clause.replace(_READ, f"{_READ}{in_action}") for clause in before]
        sentence = f"{head}: {'; '.join([*clauses_of, success])}{guess}."
        if count_words(sentence) < MOST_WORDS and len(re.findall(r"\d+", sentence)) <= MOST_NUMBERS:
            break
    return sentence


_READ = "probes read the answer in the backbone"


def _in_action(row: RetentionRow) -> str:
    """Return what probes show of the action stream, in the words of its verdict; *not shown* claims no absence."""
    if row.action.verdict is None:
        return ""
    words = " and" if _holds(row.action) else f", {'absent' if row.action.verdict == 'absent' else 'not shown'} in"
    return f"{words} the {row.run.action_name}"


def _head(row: RetentionRow, vlm: RetentionRow | None, used: str) -> str:
    """Return the verdict: whether the VLM knows the answer, the policy encodes it, and the action uses it."""
    stages = ["known"] * (vlm is not None and knows(vlm)) + ["encoded"] * _is_encoded(row)
    return ", ".join(filter(None, (" and ".join(stages), used)))


def _of_use(row: RetentionRow, vlm: RetentionRow | None, use: UseVerdict) -> str:
    """Return the sentence of a row whose pictures were swapped."""
    verdict, what = use.finding
    if verdict == "used":
        return _sentence(verdict, *_read_and(row, "the action follows"), row=row)
    if verdict == "not used" and use.is_of_first_chunk and knows(row):
        what = "the first actions do not follow the answer, later ones may"
        return _sentence(_head(row, vlm, "not used at first"), what, *_missing(row), row=row)
    if verdict == "not used":
        return _sentence(_head(row, vlm, verdict), *_read_and(row, "the action does not follow"), row=row)
    if use.behaviour == "undecided" and not use.lacks_control:
        read = [_READ] if _is_encoded(row) else _missing(row, "the answer")
        return _sentence(
            _head(row, vlm, verdict), *read, more_groups(row.image_swap, row.success.n_groups or 0), row=row
        )
    if verdict in ("not decisive", "use undecided"):
        return _sentence(_head(row, vlm, verdict), what, *_missing(row), row=row)
    return _sentence(verdict, what, row=row)


def _holds(part: StreamPart) -> bool:
    """Return whether the answer is shown in a stream; one without a score shows nothing."""
    return part.has_signal and part.score is not None


def _is_encoded(row: RetentionRow) -> bool:
    return _holds(row.backbone)


def _read_and(row: RetentionRow, action: str) -> list[str]:
    """Return that probes read the answer and what the action does with it; else what is missing."""
    if _is_encoded(row):
        return [f"{_READ}, {action} it"]
    return [f"{action} the answer", *_missing(row)]


def _missing(row: RetentionRow, answer: str = "it") -> list[str]:
    """Return why the answer is not known to be in the backbone; nothing where it is."""
    if not is_probed(row):
        return [unprobed(row)]
    if _is_encoded(row):
        return []
    return [f"probes do not show {answer} in the backbone"]


def _unread(row: RetentionRow) -> str:
    """Return what is known of a backbone without signal."""
    part, items = row.backbone, row.success.n_items
    if part.score is None:
        return "too few groups of items to measure the answer in the backbone"
    if part.verdict == "absent":
        return f"probes of {items} items do not find the answer in the backbone"
    if part.remedy:
        few = "permutations" if "permutations" in part.remedy else "groups"
        return f"too few {few} to show it, {part.remedy}"
    missed = [_CONTROLS.get(name, name) for name, better in part.exceeds.items() if better is False]
    if part.exceeds["chance"]:
        return f"probes of the backbone do no better than {' and '.join(missed)}"
    return more_items(row) or f"{items} items are too few to tell what the backbone holds"


def _beside_guessing(row: RetentionRow) -> str:
    if knows(row):
        return ", guessing 50 %"
    return ", less than guessing" if row.success.regime == Regime.FAILURE else ", guessing possible"


def _success(row: RetentionRow) -> str:
    """Return how a policy does."""
    if row.success.sr is None:
        return "the model did not act" if row.run.capture_only else "success is not known"
    return f"success {whole_percent(row.success.sr)} %"


def _without_signal(row: RetentionRow, vlm: RetentionRow | None) -> str:
    missing = "absent" if row.backbone.verdict == "absent" else "not shown"
    return f"known, {missing} in the backbone" if vlm is not None and knows(vlm) else missing


def _without_swap(row: RetentionRow, vlm: RetentionRow | None) -> str:
    """Return the sentence of a row whose pictures were not swapped."""
    if is_probed(row) and _is_encoded(row):
        tested = "use not tested" if row.success.sr is not None else ""
        return _sentence(_head(row, vlm, tested), _READ, row=row)
    if is_probed(row):
        return _sentence(_without_signal(row, vlm), _unread(row), row=row)
    if row.success.sr is None:
        return f"not measured: {_success(row)}, and {unprobed(row)}."
    words = {Regime.KNOWLEDGE: "success", Regime.FAILURE: "failure"}
    head = words.get(row.success.regime or Regime.NO_RELIABLE_KNOWLEDGE, "success not shown")
    against_guessing = "" if head == "success" else f", {_against_guessing(row)}"
    return f"{head}: the cube ends right in {whole_percent(row.success.sr)} %{against_guessing}; {unprobed(row)}."


# -- what to do next ----------------------------------------------------------------------------------------------


def next_step(rows: Sequence[RetentionRow]) -> str:
    """Return the command for what is open in the first run, and what it answers; empty without a policy."""
    acts = [row for row in rows if row.is_side and row.category != MEAN and not is_vlm(row)]
    if not acts:
        return ""
    of_run = [row for row in acts if row.key == acts[0].key]
    run = shlex.quote(of_run[0].run.location)
    has_activations = of_run[0].run.action_stream is not None
    command = probe_command(run, {row.category: row.success.n_groups or 0 for row in of_run})
    if has_activations and not any(map(is_probed, of_run)) and command:
        return f"next: {command}  where inside the answer can be read"
    if has_activations and any(row.image_swap.use is None for row in of_run) and not of_run[0].run.capture_only:
        return f"next: probe-kit intervene {run}  whether the action follows the answer"
    if any("permutations" in row.backbone.remedy for row in of_run):
        fewest = permutations_for()
        return f"next: probe-kit train {run} --permutations 200  because fewer than {fewest} show nothing"
    if any(is_probed(row) and not _is_encoded(row) and row.backbone.verdict != "absent" for row in of_run):
        return "next: probe-kit power  how many items would show what is open"
    return f"next: probe-kit view {run}  episode by episode, in a browser"
