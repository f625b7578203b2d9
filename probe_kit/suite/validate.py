"""`validate_suite`: all rules and, on request, the leakage checks, in one report."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from probe_kit._system.counting import counted
from probe_kit.suite.categories import CATEGORIES, category_of
from probe_kit.suite.leakage import Baseline, run_baselines, save_baselines
from probe_kit.suite.manifest import read_suite
from probe_kit.suite.suite import missing_categories
from probe_kit.suite.validation.records import Finding, listing, warning
from probe_kit.suite.validation.rules import DECODING_RULES
from probe_kit.suite.validation.warnings import WARNING_RULES


@dataclass(frozen=True)
class Report:
    """The findings on a suite: violated rules, warnings, and baselines.

    suite: its identity, or its folder if the card cannot be read. baselines: None if they were not run.
    """

    suite: str
    missing: tuple[str, ...]
    findings: tuple[Finding, ...]
    baselines: tuple[Baseline, ...] | None = None

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that make the suite unusable."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """All other findings."""
        return tuple(finding for finding in self.findings if finding.severity == "warning")

    @property
    def ok(self) -> bool:
        """Whether the suite is valid and, where baselines were run, no answer leaks."""
        return not self.errors and all(baseline.ok for baseline in self.baselines or ())

    def to_json(self) -> dict[str, Any]:
        """All of it as plain values, every finding included."""
        baselines = None if self.baselines is None else [asdict(b) | {"ok": b.ok} for b in self.baselines]
        return {
            "suite": self.suite,
            "ok": self.ok,
            "missing": list(self.missing),
            "findings": [asdict(finding) for finding in self.findings],
            "baselines": baselines,
        }

    def to_text(self) -> str:
        """Return the text for a terminal: at most 20 findings of each rule, the baselines, the verdict."""
        lines = [listing(self.errors), listing(self.warnings)]
        lines += [f"{category_of(baseline.category).title}: {baseline}" for baseline in self.baselines or ()]
        # A few questions of one's own that happen to be of a category of the paper do not claim to be its set.
        if 0 < len(self.missing) <= len(CATEGORIES) // 2:
            lines.append(f"Not in this suite: {', '.join(category_of(slug).title for slug in self.missing)}.")
        verdict = "valid" if self.ok else "not valid"
        counts = f"{counted(len(self.errors), 'error')}, {counted(len(self.warnings), 'warning')}"
        lines.append(f"{self.suite}: {verdict}, {counts}")
        return "\n".join(line for line in lines if line)


def validate_suite(
    folder: Path | str,
    baselines: bool = False,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """A report on the suite in `folder`.

    baselines: also runs the leakage gates and stores them in the suite's `baselines.json`; not on a suite with
    errors. progress: called with categories done and categories in all. Raises UsageError if there is no suite.
    """
    folder = Path(folder).absolute()
    suite, findings = read_suite(folder)
    if suite is None:
        return Report(str(folder), (), tuple(findings))
    findings += [finding for rule in DECODING_RULES for finding in rule(suite)]
    undecodable = any(finding.rule in ("E05", "E07") for finding in findings)
    if not undecodable:
        findings += [finding for rule in WARNING_RULES for finding in rule(suite)]
    gates = None
    if baselines and not any(finding.severity == "error" for finding in findings):
        gates = run_baselines(suite, seed, progress)
        save_baselines(suite, gates)
        findings += _leaks(gates)
    once = tuple(dict.fromkeys(findings))  # two pictures of two items can give one line twice
    return Report(suite.identity, tuple(missing_categories(suite.items)), once, gates)


_BOTH_WAYS = (
    "The answer shows without understanding the question. Ask each pair of pictures both ways, so that "
    "every picture is as often right as wrong"
)
_REMEDIES = {
    "position": "The answer lies on one side. Let it lie left as often as right",
    "instruction": _BOTH_WAYS,
    "pixels": _BOTH_WAYS,
    "statistics": _BOTH_WAYS,
}


def _leaks(baselines: tuple[Baseline, ...]) -> list[Finding]:
    """W05: a baseline knows more than a coin."""
    return [
        warning("W05", category_of(baseline.category).title, f"{baseline}. {_REMEDIES[baseline.name]}")
        for baseline in baselines
        if not baseline.ok
    ]
