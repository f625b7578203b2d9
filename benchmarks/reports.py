"""What a table, the report and the figures of a run of the paper's size cost: 3,440 episodes with frames.

    python benchmarks/reports.py FOLDER [--episodes 3440] [--permutations 20] [--only html]

The run is made in FOLDER first, see `full_run.py`, or the one that is there is used. Each command runs in a
process of its own: processor and wall seconds, peak memory, bytes written. Linux counts into a child's peak what
its parent held when it began, so this process imports nothing of ours. The report is then opened in Chromium: how
long until its load event has ended, by which the episodes' first cards are drawn.
Rivals, in the same run: `probe-kit retention` without anything drawn, `--help` (the interpreter and its imports),
and an empty page in the same browser.
"""

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

REPORT, FIGURES, BROWSER = "report.html", "figures", "chromium"


@dataclass(frozen=True)
class Cost:
    """Of one command. memory: peak resident bytes."""

    wall: float
    processor: float
    memory: int


def command(*arguments: str) -> Cost:
    """Run `probe-kit` with these arguments in a process of its own, its output thrown away."""
    began = time.perf_counter()
    pid = os.posix_spawn(
        sys.executable, [sys.executable, "-m", "probe_kit", *arguments], os.environ,
        file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
                      (os.POSIX_SPAWN_OPEN, 2, os.devnull, os.O_WRONLY, 0)],
    )  # fmt: skip
    _, status, used = os.wait4(pid, 0)
    if status:
        raise SystemExit(f"probe-kit {' '.join(arguments)} ended with {os.waitstatus_to_exitcode(status)}")
    return Cost(time.perf_counter() - began, used.ru_utime + used.ru_stime, _peak(used))


def _peak(used: resource.struct_rusage) -> int:
    """Linux counts kB, macOS bytes."""
    return used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def bench_commands(run: Path, folder: Path, only: str | None) -> None:
    """Table, report, figures."""
    ways = {
        "--help": ["--help"],
        "table": ["retention", str(run)],
        "json": ["retention", str(run), "--format", "json"],
        "html": ["retention", str(run), "--html", str(folder / REPORT)],
        "figures": ["retention", str(run), "--figures", str(folder / FIGURES)],
    }
    print(f"{'command':10}{'wall s':>9}{'CPU s':>9}{'peak MB':>9}  written")
    for name, arguments in ways.items():
        if only not in (None, name):
            continue
        cost = command(*arguments)
        written = {"html": folder / REPORT, "figures": folder / FIGURES}.get(name)
        size = "" if written is None else _size(written)
        print(f"{name:10}{cost.wall:9.1f}{cost.processor:9.1f}{cost.memory / 1e6:9.0f}  {size}", flush=True)


def _size(written: Path) -> str:
    """Files and megabytes."""
    sizes = [path.stat().st_size for path in (written, *written.rglob("*")) if path.is_file()]
    return f"{len(sizes)} files, {sum(sizes) / 1e6:.1f} MB"


_NOTE = """<script>addEventListener("load", () => setTimeout(() => {
const [entry] = performance.getEntriesByType("navigation");
document.title = "times " + JSON.stringify([entry.loadEventEnd, document.querySelectorAll("#grid .card").length,
  document.getElementsByTagName("*").length]);
}))</script>"""
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--window-size=1400,1000",
)  # fmt: skip


def opened(page: Path) -> tuple[float, int, int, float]:
    """Milliseconds from navigation to the end of the load event, cards and elements then, processor seconds.

    The page is a copy that notes its own times in its title: that needs no driver, but for Chromium.
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        noted = Path(profile) / "noted.html"
        text = page.read_text(encoding="utf-8")
        noted.write_text(text.replace("</title>", f"</title>{_NOTE}", 1), encoding="utf-8")
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        arguments = [BROWSER, *_FLAGS, f"--user-data-dir={profile}", "--dump-dom", noted.as_uri()]
        output = subprocess.run(arguments, capture_output=True, encoding="utf-8", check=True, timeout=300).stdout
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    match = re.search(r"<title>times (\[.*?\])</title>", output)
    if match is None:
        raise SystemExit(f"{page} did not finish loading in {BROWSER}")
    milliseconds, cards, elements = json.loads(match[1])
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return milliseconds, cards, elements, processor


def bench_opening(folder: Path, repeats: int = 5) -> None:
    """The report in Chromium, against an empty page, in turns."""
    if shutil.which(BROWSER) is None:
        print(f"not opened: no {BROWSER} on this machine")
        return
    empty = folder / "empty.html"
    empty.write_text("<!doctype html><title>empty</title><div id=grid></div>", encoding="utf-8")
    pages = {"empty page": empty, "report": folder / REPORT}
    turns: dict[str, list[tuple[float, int, int, float]]] = {name: [] for name in pages}
    for _ in range(repeats):
        for name, path in pages.items():
            turns[name].append(opened(path))
    for name, opening_times in turns.items():
        times, processor = (
            sorted(turn[0] / 1e3 for turn in opening_times),
            median(turn[3] for turn in opening_times),
        )
        print(f"{name}: loaded after {median(times):.2f} s ({times[0]:.2f} to {times[-1]:.2f}), whole browser "
              f"{processor:.1f} CPU-s; {opening_times[0][1]} cards, {opening_times[0][2]} elements")  # fmt: skip


def main() -> None:
    """All of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--episodes", type=int, default=3440)
    parser.add_argument("--permutations", type=int, default=20)
    parser.add_argument("--only")
    options = parser.parse_args()
    full_run_command = [str(Path(__file__).with_name("full_run.py")), str(options.folder)]
    full_run_command += ["--episodes", str(options.episodes), "--permutations", str(options.permutations)]
    subprocess.run([sys.executable, *full_run_command], check=True)
    run = options.folder / "run"
    print(f"of which frames {_size(run / 'frames')}, probes {_size(run / 'probes')}")
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    bench_commands(run, options.folder, options.only)
    bench_opening(options.folder)


if __name__ == "__main__":
    main()
