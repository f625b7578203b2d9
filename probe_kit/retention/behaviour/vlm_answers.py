"""VLM runs among policy runs: which they are, and by which of their scores they are read.

A VLM run holds three outcomes of every episode: of the text, of the options' logits, and of these with the
preference for a letter taken out. A table shows one of them, and the shares of the others beside it.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

from probe_kit.errors import UsageError
from probe_kit.runs.reader import RunReader

if TYPE_CHECKING:
    import pandas as pd

SCORES: Mapping[str, tuple[str, str]] = {
    "text": ("outcome", "side_placed"),
    "logits": ("outcome_logits", "side_logits"),
    "order-balanced": ("outcome_debiased", "side_debiased"),
}
"""By score, the columns of outcome and side."""


def ask_of(run: RunReader) -> Mapping[str, Any] | None:
    """Return how a run was asked, None for one that acts."""
    ask: Mapping[str, Any] | None = run.settings.get("ask")
    return ask


MANY_BY_CLAUSE = 0.05
"""Share of answers found among other words from which the accuracy without them is shown too."""


def read_by_clause(episodes: "pd.DataFrame", text: "pd.Series[str]") -> tuple[float, float | None]:
    """The share of answers that were found among other words, and the accuracy with these as unparsable.

    text: outcomes of the answers in text. The accuracy is None where the share is `MANY_BY_CLAUSE` or less.
    """
    in_clause = episodes["parse_tier"] == "clause"
    share = float(in_clause.mean())
    return share, float(((text == "correct") & ~in_clause).mean()) if share > MANY_BY_CLAUSE else None


class ScoredAnswers:
    """A VLM run, read by one of its scores; everything else is the run's own.

    with_side_words: keep items in whose name a side stands, such as "no left turn sign": answers and
    names of these are not distinguishable.
    """

    def __init__(self, run: RunReader, score: str = "text", with_side_words: bool = False) -> None:
        if score not in SCORES:
            raise UsageError(f"score is {score!r}; expected one of {', '.join(SCORES)}")
        self._run, self.score, self._with_side_words = run, score, with_side_words

    def __getattr__(self, name: str) -> Any:
        return getattr(self._run, name)

    @cached_property
    def episodes(self) -> "pd.DataFrame":
        """Return the episodes of the run with `outcome` and `side_placed` by the score; `outcome_text` stays."""
        episodes = self._run.episodes
        if not self._with_side_words and "side_word" in episodes:
            episodes = episodes[~episodes["side_word"].astype(bool)]
        outcome, side = SCORES[self.score]
        return episodes.assign(
            outcome_text=episodes["outcome"], outcome=episodes[outcome], side_placed=episodes[side]
        )


def scored(run: RunReader, score: str, with_side_words: bool = False) -> RunReader:
    """A VLM run by a score; a policy run as it is. Raises UsageError for an unknown score."""
    if score not in SCORES:
        raise UsageError(f"score is {score!r}; expected one of {', '.join(SCORES)}")
    if ask_of(run) is None:
        return run
    wrapped: RunReader = ScoredAnswers(run, score, with_side_words)
    return wrapped


def left_out(runs: Sequence[RunReader]) -> list[str]:
    """A sentence per VLM run whose items with side words are not counted."""
    return [
        f"{run.location}: {missing} episodes are left out because a side stands in the name that was asked for, "
        "such as 'no left turn sign' (--with-side-words counts them)."
        for run in runs
        if isinstance(run, ScoredAnswers) and (missing := len(run._run.episodes) - len(run.episodes))
    ]
