"""How long does the viewer take until a page shows data, and what does the page hold in memory?

    python benchmarks/viewer.py RUN [--export]
    python benchmarks/viewer.py --frames

Served: `probe-kit view` as a user starts it, from the command to its address, then to the drawn overview. Then
every view in the same page. With `--export` the same of an exported folder, whose export is timed in CPU seconds.
There also what a user waits for: the next step, a filter, the next episode. Chromium is that of the tests.
`--frames`: CPU seconds per episode that pi0-tiny takes with and without `--frames all`, user and system time of
the whole command. Two lengths of run are subtracted from each other, so that loading does not count.
Durations are wall clock; the load of the machine is printed beside them.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import tests_of_checkout  # noqa: F401

from probe_kit import open_run
from probe_kit.view import write_viewer
from probe_kit.view.export import page_files
from tests.support.browser import CHROMIUM, WHY_SKIPPED, Browser

VIEWS = {
    "overview": ("#/overview", "document.querySelector('.overview tbody tr')"),
    "layer × iteration": ("#/map", "document.querySelector('.readout')"),
    "episode": ("#/episodes?ep=1&t=0", "document.querySelector('.charts svg')"),
    "questions": ("#/questions", "document.querySelector('main tbody tr')"),
}
"""By view its address, and what is there once it is drawn."""
REPEATS = 15
PRESS = "document.body.dispatchEvent(new KeyboardEvent('keydown', {key: %s, bubbles: true}))"
CHOOSE = """(() => { const one = document.querySelector(%s); one.value = %s;
    one.dispatchEvent(new Event(one.tagName === 'SELECT' ? 'change' : 'input', {bubbles: true})); })()"""
TIMED = """new Promise(done => {
    const read = () => document.querySelector(%s)?.innerText, before = read(), began = performance.now();
    const drawn = () => requestAnimationFrame(() => read() === before ? drawn() : requestAnimationFrame(() =>
        done(performance.now() - began)));
    %s; drawn(); })"""
"""Milliseconds from an input until the frame behind the one in which a text has changed."""
FRAME_EPISODES, FRAME_REPEATS = (4, 48), 3
"""Episodes of the two runs that are subtracted from each other; how often each is made. The shortest counts."""


def report(name: str, text: str) -> None:
    """One line with the load of the machine."""
    print(f"{name:42s} {text:>24s}   load {os.getloadavg()[0]:.1f}", flush=True)


def seconds_to(page: Any, address: str, drawn: str) -> float:
    """From the request of an address until something is drawn."""
    began = time.perf_counter()
    page.call("Page.navigate", url=address)
    page.wait(drawn)
    return time.perf_counter() - began


def measure_views(browser: Any, base: str, where: str) -> None:
    """Seconds, heap and elements of each view in a fresh page. base: address of the page without a view."""
    for name, (fragment, drawn) in VIEWS.items():
        page = browser.page()
        page.call("Performance.enable")
        took = seconds_to(page, f"{base}{fragment}", drawn)
        page.call("HeapProfiler.collectGarbage")
        metrics = {metric["name"]: metric["value"] for metric in page.call("Performance.getMetrics")["metrics"]}
        nodes = page.read("document.querySelectorAll('*').length")
        heap = metrics["JSHeapUsedSize"] / 1e6
        report(f"{where}: {name}", f"{took:.2f} s, {heap:.0f} MB, {nodes} elements")


@contextmanager
def served(run: str) -> Iterator[str]:
    """The address that `probe-kit view` prints."""
    command = [sys.executable, "-m", "probe_kit", "view", run, "--no-browser"]
    began = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, encoding="utf-8") as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            report("command to address", f"{time.perf_counter() - began:.2f} s")
            yield address
        finally:
            process.terminate()


def measure_server(browser: Any, run: str) -> None:
    """From the command to the overview, and the views of a server that has its tables."""
    with served(run) as address:
        page = browser.page()
        began = time.perf_counter()
        page.call("Page.navigate", url=address)
        page.wait("document.querySelector('.loading, .overview')")
        report("address to the name of the run", f"{time.perf_counter() - began:.2f} s")
        page.wait(VIEWS["overview"][1])
        report("address to the drawn overview", f"{time.perf_counter() - began:.2f} s")
        for name, (fragment, drawn) in VIEWS.items():
            took = seconds_to(page, f"{address.partition('?')[0]}{fragment}", drawn)
            report(f"served, again: {name}", f"{took:.2f} s")


def measure_inputs(browser: Any, base: str) -> None:
    """Median milliseconds of what a user does most, in the list of all episodes."""
    page = browser.page()
    seconds_to(page, f"{base}#/episodes?t=0", VIEWS["episode"][1])
    filters = page.read(
        "[...document.querySelector('select[name=outcome]').options].slice(0, 2).map(o => o.value)"
    )
    inputs = {
        "next step": (".scrub output", lambda _: PRESS % json.dumps("ArrowRight")),
        "next episode": (".episode .facts", lambda _: PRESS % json.dumps("j")),
        "filter": ("output.count", lambda n: CHOOSE % ("'select[name=outcome]'", json.dumps(filters[1 - n % 2]))),
        "words": ("output.count", lambda n: CHOOSE % ("'input[name=words]'", json.dumps("1" * (n % 2 == 0)))),
    }
    for name, (text, action) in inputs.items():
        took = [page.read(TIMED % (json.dumps(text), action(n))) for n in range(REPEATS)]
        report(f"file: {name}", f"{statistics.median(took):.0f} ms, at most {max(took):.0f}")


def measure_export(browser: Any, run: str, folder: Path) -> None:
    """CPU seconds of an export without frames, and the views from its files."""
    began = time.process_time()
    page = write_viewer([open_run(run, allow_partial=True)], folder / "viewer", frames=False)
    report("export without frames", f"{time.process_time() - began:.0f} CPU-s")
    measure_views(browser, page.as_uri(), "file")
    measure_inputs(browser, page.as_uri())


def extraction_seconds(episodes: int, frames: str, out: Path) -> float:
    """CPU seconds of an extraction of pi0-tiny, its children's included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "probe_kit", "extract", "--model", "pi0-tiny", "--categories", "color"]
    command += ["--items", str(episodes // 2), "--frames", frames, "--env-workers", "0", "--out", str(out)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure_frames(folder: Path) -> None:
    """CPU seconds per episode with the first and last frame, and with all of them."""
    few, many = FRAME_EPISODES
    seconds_by_size: dict[tuple[str, int], list[float]] = defaultdict(list)
    for repeat in range(FRAME_REPEATS):  # in turn, since the speed of a shared machine drifts
        for count in FRAME_EPISODES:
            for frames in ("ends", "all"):
                seconds = extraction_seconds(count, frames, folder / f"{frames}-{count}-{repeat}")
                seconds_by_size[frames, count].append(seconds)
    took = {}
    for frames in ("ends", "all"):
        took[frames] = (min(seconds_by_size[frames, many]) - min(seconds_by_size[frames, few])) / (many - few)
        report(f"extract --frames {frames}", f"{took[frames]:.3f} CPU-s an episode")
    report("--frames all costs", f"{100 * (took['all'] / took['ends'] - 1):.0f} %")


def main() -> None:
    """Print a line per measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?", help="run with probes, such as that of full_run.py")
    parser.add_argument("--export", action="store_true", help="measure an exported folder too")
    parser.add_argument("--frames", action="store_true", help="measure `extract --frames all` instead")
    options = parser.parse_args()
    if options.frames:
        with tempfile.TemporaryDirectory() as folder:
            measure_frames(Path(folder))
        return
    if options.run is None:
        parser.error("give a run, or --frames")
    code = [len(content) for name, content in page_files().items() if "LICENSE" not in name]
    report("page code, without licences", f"{sum(code) / 1000:.0f} kB")
    if CHROMIUM is None:
        sys.exit(WHY_SKIPPED)
    scratch = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
    with scratch as folder, Browser(Path(folder) / "profile") as browser:
        measure_server(browser, options.run)
        if options.export:
            measure_export(browser, options.run, Path(folder))


if __name__ == "__main__":
    main()
