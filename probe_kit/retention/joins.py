"""Every VLM run of a table joined with every acting one that began with the same frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

from probe_kit.errors import OtherFramesError, UsageError
from probe_kit.retention.behaviour import ask_of, capture_only
from probe_kit.retention.compare.known_used import KnownUsedTable, correct_joins, match_runs
from probe_kit.retention.rows.outcome_rules import can_be_judged, under_rule
from probe_kit.retention.table import RetentionTable
from probe_kit.runs.reader import RunReader


@dataclass(frozen=True)
class Joins:
    """tables: of the pairs that could be joined. refused: why other pairs could not, a sentence each."""

    tables: tuple[KnownUsedTable, ...]
    refused: tuple[str, ...]


def joins_of(runs: Sequence[RunReader], table: RetentionTable) -> Joins:
    """Answer, probe and success of every pair of a VLM run and a policy run.

    runs: those that the table is made of, as it reads them; probes, outcome rule and names are the table's. Tests
    are corrected over all pairs.
    """
    names = {row.run.location: row.run.label for row in table.rows}
    vlms = [run for run in runs if ask_of(run) is not None]
    policies = [run for run in runs if ask_of(run) is None and _judged(run, table)]
    joins, refused = [], []
    for vlm, policy in product(vlms, policies):
        judged = under_rule(policy, table.rule, table.last_steps)
        try:
            joined = match_runs(vlm, judged, table.results_of(policy.location))
        except (UsageError, OtherFramesError) as error:
            refused.append(f"Not joined: {error}.")
            continue
        asked_as, acted_as = (names.get(str(run.location), run.label) for run in (vlm, policy))
        joins.append(replace(joined, asked=asked_as, acted=acted_as))
    return Joins(tuple(correct_joins(joins)), tuple(refused))


def _judged(run: RunReader, table: RetentionTable) -> bool:
    return not capture_only(run.episodes) and can_be_judged(run, table.rule, table.last_steps)
