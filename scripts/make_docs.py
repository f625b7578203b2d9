"""Make the tables and figures of README and docs that come from the demo: `python scripts/make_docs.py FOLDER`.

FOLDER/demo: what `probe-kit demo` makes; FOLDER/compare: what `probe-kit demo --compare` makes. What is missing
is made first: 2 minutes and 20 to 40 minutes on two cores. The numbers go to `docs/demo.json`, and from there, by
`docs_tables`, into the pages; a test compares them. `--demo-only` keeps the stored numbers of `--compare`.
"""

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from docs_tables import DATA, PAGES, README, ROOT, filled
from readme_picture import draw_picture

from probe_kit._terminal.console import counter, progress
from probe_kit.demo.pipeline import (
    FULL,
    QUICK,
    TRAINED,
    Demo,
    NamedProgress,
    OrganismVerdict,
    Size,
    compare_organisms,
    run_demo,
)
from probe_kit.retention.columns.text import verdict
from probe_kit.retention.report import write_report

SAMPLE = "sample-report.html"
SAMPLE_PICTURES = 80
"""Episodes of the sample report that show their frames, so that it has at most 1 MB."""


def main() -> None:
    """Run what has to be run, then write numbers, tables and figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--demo-only", action="store_true")
    options = parser.parse_args()
    demo: Path = options.folder / "demo"
    content = json.loads(DATA.read_text(encoding="utf-8"))
    with progress() as bar:
        finished_demo = run_demo(demo, lambda stage: counter(bar, stage))
        content["demo"] = _measured(_of_trained(finished_demo), QUICK)
        if not options.demo_only:
            content["compare"] = _compared(options.folder / "compare", lambda stage: counter(bar, stage))
    DATA.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for page in (README, *PAGES):
        page.write_text(filled(page.read_text(encoding="utf-8"), content), encoding="utf-8")
    write_report(
        [finished_demo.vlm_run, finished_demo.run],
        ROOT / "docs" / SAMPLE,
        finished_demo.table,
        pictures=SAMPLE_PICTURES,
    )
    draw_picture(demo, content["demo"]["probes"])
    shutil.copyfile(demo / "episode.gif", ROOT / "docs" / "episode.gif")
    sheet = [sys.executable, str(ROOT / "benchmarks" / "env.py"), "sheet", str(ROOT / "docs" / "scenes.png")]
    subprocess.run(sheet, check=True)


def _of_trained(demo: Demo) -> list[OrganismVerdict]:
    return [
        OrganismVerdict(TRAINED.name, row.category, TRAINED.expected(row.category), verdict(row), row)
        for row in demo.table.rows
        if row.run.mode == "acts"
    ]


def _compared(folder: Path, stage: NamedProgress) -> dict[str, Any]:
    return _measured(
        [finding for finding in compare_organisms(folder, stage) if finding.row.run.mode == "acts"], FULL
    )


def _measured(findings: Iterable[OrganismVerdict], size: Size) -> dict[str, Any]:
    """The numbers of some policies on one suite, and what they were measured with: that of the trained one."""
    findings = list(findings)
    run = next(finding.row.run for finding in findings if finding.organism == TRAINED.name)
    return {
        "suite": run.suite,
        "weights": run.weights_sha256,
        "run_settings": run.settings,
        "probes": run.probes,
        "permutations": size.permutations,
        "organisms": list(map(_finding, findings)),
    }


def _finding(finding: OrganismVerdict) -> dict[str, object]:
    row = finding.row
    return {
        "organism": finding.organism,
        "category": finding.category,
        "items": row.success.n_items,
        "expected": finding.expected,
        "measured": finding.measured,
        "agreement": finding.agreement,
        "sr": row.success.sr,
        "chance_margin": row.success.chance_margin,
        "backbone": row.backbone.score,
        "backbone_ci": row.backbone.ci,
        "verdict": row.backbone.verdict,
        "at_most": row.backbone.at_most,
        "action": row.action.score,
        "retention": row.retention.value if row.retention.defined else None,
        "retention_ci": row.retention.ci if row.retention.defined else None,
    }


if __name__ == "__main__":
    main()
