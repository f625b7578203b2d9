"""Findings of validation rules, and their listing."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from typing import Literal

PRINTED_PER_RULE = 20


@dataclass(frozen=True)
class Finding:
    """One violation of one rule; errors make a suite unusable, warnings do not."""

    rule: str
    severity: Literal["error", "warning"]
    where: str
    message: str

    def __str__(self) -> str:
        return f"{self.rule} {self.where}: {self.message}"


def error(rule: str, where: str, message: str) -> Finding:
    """A finding that makes the suite unusable."""
    return Finding(rule, "error", where, message)


def warning(rule: str, where: str, message: str) -> Finding:
    """A finding that results survive, if one knows of it."""
    return Finding(rule, "warning", where, message)


def listing(findings: Iterable[Finding]) -> str:
    """The findings as lines sorted by rule, at most 20 of each rule and then how many more there are."""
    lines = []
    for rule, same_rule in groupby(sorted(findings, key=attrgetter("rule")), key=attrgetter("rule")):
        found = [str(finding) for finding in same_rule]
        lines += found[:PRINTED_PER_RULE]
        if len(found) > PRINTED_PER_RULE:
            lines.append(f"{rule}: and {len(found) - PRINTED_PER_RULE} more")
    return "\n".join(lines)
