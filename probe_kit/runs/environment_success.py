"""Success rates of runs in environments of the user's own or of clients, and what may have lowered them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Self

from probe_kit._system.counting import describe_range, plural
from probe_kit.runs.layout import AT_END, CONDITION, LIMIT, ONCE, POSSIBLE_STARTS, UNEDITED

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ConditionSuccess:
    """The success rate of the episodes of one condition.

    Attributes:
        n_episodes: The number of episodes of which success is said.
        sr: The share of them with success.
        difference: The mean over groups of the rate minus that of the condition `none` in the same group; None for
            `none` itself, and where no group has both.
        n_groups: The number of groups that have both.
    """

    name: str
    n_episodes: int
    sr: float
    difference: float | None = None
    n_groups: int = 0

    @property
    def words(self) -> str:
        """The rate, and the difference within groups."""
        rate = f"{self.name} {self.sr:.0%} of {self.n_episodes}"
        if self.difference is None:
            return rate
        groups = plural(self.n_groups, "group")
        return f"{rate} ({100 * self.difference:+.0f} points within {groups})"


@dataclass(frozen=True)
class EnvironmentSuccess:
    """The success rates of the episodes of an environment; shares are 0 to 1.

    Attributes:
        sr: The share of episodes with success after the last action.
        success_once: The share of episodes with success after any action, the rate that lerobot-eval prints. None
            where clients of a policy server said how episodes ended, and no more.
        stopped: The number of episodes that `--max-steps` ended before the environment's own limit.
        steps: The actions after which they ended.
        limits: The environment's own limits of these episodes, in actions.
        conditions: The rates by condition, where a policy server changed the streams of some episodes.
    """

    n_episodes: int
    sr: float
    success_once: float | None
    stopped: int = 0
    steps: tuple[int, ...] = ()
    limits: tuple[int, ...] = ()
    conditions: tuple[ConditionSuccess, ...] = ()

    @classmethod
    def of(cls, episodes: "pd.DataFrame") -> Self | None:
        """Return the rates of a run's episodes; None without the fact `success`, and of guessed episodes."""
        if AT_END not in episodes or episodes.empty or why_no_rates(episodes) is not None:
            return None
        rated = episodes.dropna(subset=[name for name in (ONCE, AT_END) if name in episodes])
        stopped = rated.iloc[:0]
        if {LIMIT, "steps", "done"} <= set(rated):
            stopped = rated[~rated["done"].astype(bool) & (rated["steps"] < rated[LIMIT])]
        return cls(
            len(rated),
            float(rated[AT_END].astype(bool).mean()),
            float(rated[ONCE].astype(bool).mean()) if ONCE in rated else None,
            len(stopped),
            tuple(sorted({int(steps) for steps in stopped["steps"]})) if len(stopped) else (),
            tuple(sorted({int(limit) for limit in stopped[LIMIT]})) if len(stopped) else (),
            _by_condition(rated),
        )

    def to_json(self) -> Mapping[str, Any]:
        """Return the rates as plain values."""
        return {
            "n_episodes": self.n_episodes,
            "sr": self.sr,
            ONCE: self.success_once,
            "stopped_below_limit": self.stopped,
            "limits": list(self.limits),
            **({"conditions": [asdict(rate) for rate in self.conditions]} if self.conditions else {}),
        }

    @property
    def sentence(self) -> str:
        """Both rates, and that `--max-steps` lowered them where it may have."""
        episodes = plural(self.n_episodes, "episode")
        if self.conditions:
            rates = "; ".join(rate.words for rate in self.conditions)
            return f"success rate by condition, of {episodes}: {rates}"
        if self.success_once is None:
            return f"success rate {self.sr:.0%} of {episodes}, as their clients said at the end"
        rates = (
            f"success rate {self.sr:.0%} of {episodes}, by their last action; "
            f"{ONCE} {self.success_once:.0%}, by any action, as lerobot-eval counts"
        )
        if not self.stopped:
            return rates
        limit = f"limit is {describe_range(self.limits)}" if self.limits else "limit is unknown"
        return (
            f"{rates}. --max-steps ended {self.stopped} of them after {counted_steps(self.steps)}, and the "
            f"environment's own {limit}: both rates may be too low"
        )


def _by_condition(episodes: "pd.DataFrame") -> tuple[ConditionSuccess, ...]:
    """Return the rates by condition, `none` in front; empty where episodes have no condition."""
    if CONDITION not in episodes:
        return ()
    success = episodes[AT_END].astype(float)
    in_groups = success.groupby([episodes["group_id"], episodes[CONDITION]]).mean().unstack()
    rates = []
    for name in sorted(in_groups.columns, key=lambda name: (name != UNEDITED, name)):
        of_condition = success[episodes[CONDITION] == name]
        gains = (in_groups[name] - in_groups.get(UNEDITED, float("nan"))).dropna()
        compared = name != UNEDITED and len(gains) > 0
        difference, groups = (float(gains.mean()), len(gains)) if compared else (None, 0)
        rates.append(ConditionSuccess(name, len(of_condition), float(of_condition.mean()), difference, groups))
    return tuple(rates)


def condition_counts(episodes: "pd.DataFrame") -> dict[str, int]:
    """Count episodes by condition, the one without edits first; empty for a run without conditions."""
    if CONDITION not in episodes:
        return {}
    counts = episodes[CONDITION].value_counts()
    return {
        str(name): int(counts[name]) for name in sorted(counts.index, key=lambda name: (name != UNEDITED, name))
    }


MARKED = "marked"
"""The column of episodes that says whether the client of a policy server said where they begin."""


def why_no_rates(episodes: "pd.DataFrame") -> str | None:
    """Return why there is no rate over some episodes: a policy server guessed where they begin; None without."""
    if MARKED not in episodes or episodes[MARKED].all():
        return None
    guessed = int((~episodes[MARKED].astype(bool)).sum())
    return (
        f"the server guessed where {guessed} of {len(episodes)} episodes begin, "
        "so that there is no rate over episodes; let clients say it (probe_kit/episode)"
    )


def bounds_of(episodes: "pd.DataFrame") -> str:
    """Return how served episodes were bounded, with counts in words; empty for other runs."""
    if MARKED not in episodes:
        return ""
    counts = {name: episodes[name].value_counts().to_dict() for name in ("began", "ended")}
    listed = {
        name: ", ".join(f"{word} {count}" for word, count in words.items()) for name, words in counts.items()
    }
    bounds = "; ".join(f"{name}: {words}" for name, words in listed.items())
    return f"{bounds}; {note}" if (note := possible_starts_of(episodes)) else bounds


def possible_starts_of(episodes: "pd.DataFrame") -> str:
    """Return how many rows may hold more than one episode, in words; empty where none is known to be such."""
    if POSSIBLE_STARTS not in episodes or not (count := int((episodes[POSSIBLE_STARTS] > 0).sum())):
        return ""
    return (
        f"{count} of {plural(len(episodes), 'row')} may hold more than one episode: they have states that may be "
        "resets"
    )


def counted_steps(steps: tuple[int, ...]) -> str:
    """Return numbers of actions in words: `1 action`, `200 actions`, `4 to 7 actions`."""
    return plural(steps[0], "action") if len(steps) == 1 else f"{describe_range(steps)} actions"
