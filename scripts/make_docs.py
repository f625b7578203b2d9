"""Make the tables and figures of README and docs that come from the demo: `python scripts/make_docs.py FOLDER`.

FOLDER: what `probe-kit demo --compare --out FOLDER` makes; what is not there is made first (5 to 20 minutes on two
cores). The numbers go to `docs/demo.json`, and from there, by `docs_tables`, into the pages; a test compares them.
The sample report is that of the demo alone: its probes are fitted again, without the control of `--compare`.
`--trained-only` makes again what concerns the trained policy alone and keeps the other organisms' stored numbers.
"""

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path

from docs_tables import DATA, PAGES, README, ROOT, filled
from readme_picture import draw_picture

from probe_kit._terminal.console import counter, progress
from probe_kit.demo.organisms import TRAINED, VLM, Finding, NamedProgress
from probe_kit.demo.pipeline import PERMUTATIONS, compare_organisms, run_demo
from probe_kit.retention import RetentionRow
from probe_kit.retention.columns.sentences import verdict
from probe_kit.retention.report import write_report
from probe_kit.retention.rows.row import MEAN

SAMPLE = "sample-report.html"
SAMPLE_PICTURES = 80
"""Episodes of the sample report that show their frames, so that it has at most 1 MB."""


def main() -> None:
    """Run what has to be run, then write numbers, tables and figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--trained-only", action="store_true")
    asked = parser.parse_args()
    with progress() as bar:
        measure(asked.folder, asked.trained_only, lambda stage: counter(bar, stage))
        write_sample(asked.folder, lambda stage: counter(bar, stage))
    for page in (README, *PAGES):
        page.write_text(
            filled(page.read_text(encoding="utf-8"), json.loads(DATA.read_text(encoding="utf-8"))),
            encoding="utf-8",
        )
    draw_picture(asked.folder, json.loads(DATA.read_text(encoding="utf-8"))["probes"])
    shutil.copyfile(asked.folder / "episode.gif", ROOT / "docs" / "episode.gif")
    sheet = [sys.executable, str(ROOT / "benchmarks" / "env.py"), "sheet", str(ROOT / "docs" / "scenes.png")]
    subprocess.run(sheet, check=True)


def measure(folder: Path, trained_only: bool, stage: NamedProgress) -> None:
    """Run the demo, and the other organisms unless `trained_only`, and write `docs/demo.json`."""
    made = run_demo(folder, stage)
    rows = [row for row in made.table.rows if row.category != MEAN and row.run.mode == "acts"]
    if trained_only:
        stored = json.loads(DATA.read_text(encoding="utf-8"))["organisms"]
        others = [one for one in stored if one["organism"] != TRAINED.name]
        findings = [_finding(_of_trained(row)) for row in rows] + others
    else:
        acted = [one for one in compare_organisms(folder, stage) if one.row.run.mode == "acts"]
        findings = [_finding(one) for one in acted]
    content = {
        "suite": made.run.suite,
        "weights": made.run.weights_sha256,
        "run_settings": made.run.settings_sha256,
        "probes": rows[0].run.probes,
        "permutations": PERMUTATIONS,
        "episodes": rows[0].success.n_episodes,
        "organisms": findings,
    }
    DATA.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def write_sample(folder: Path, stage: NamedProgress) -> None:
    """Write the report of `probe-kit demo` without `--compare`, whose probes have a control more.

    The episodes and answers are copies of those in `folder`; the probes are fitted again.
    """
    alone = folder / "alone"
    for name in ("suite", VLM.folder, TRAINED.folder):
        shutil.copytree(folder / name, alone / name, ignore=shutil.ignore_patterns("probes"), dirs_exist_ok=True)
    made = run_demo(alone, stage)
    write_report([made.asked, made.run], ROOT / "docs" / SAMPLE, made.table, pictures=SAMPLE_PICTURES)


def _of_trained(row: RetentionRow) -> Finding:
    return Finding(TRAINED.name, row.category, TRAINED.expected(row.category), verdict(row), row)


def _finding(finding: Finding) -> dict[str, object]:
    row = finding.row
    return {
        "organism": finding.organism,
        "category": finding.category,
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
