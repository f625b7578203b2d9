"""How long does the viewer take until a page shows data, and what does the page hold in memory?

    python benchmarks/viewer.py RUN [--export]

Served: `probe-kit view` as a user starts it, from the command to its address, then to the drawn overview. Then the
three views in the same page: overview, layer × iteration and one episode. With `--export` the same of an exported
folder, whose export is timed in CPU seconds. Chromium is that of the tests.
Durations are wall clock; the load of the machine is printed beside them.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

from probe_kit import open_run
from probe_kit.view import write_viewer

ROOT = Path(__file__).parents[1]
VIEWS = {
    "overview": ("#/overview", "document.querySelector('.overview tbody tr')"),
    "layer × iteration": ("#/map", "document.querySelector('.readout')"),
    "episode": ("#/episodes?ep=1&t=0", "document.querySelector('.charts svg')"),
}
"""By view its address, and what is there once it is drawn."""


def chromium_of_tests() -> Any:
    """The module that drives Chromium for the tests, which are no package."""
    spec = spec_from_file_location("browser", ROOT / "tests" / "support" / "browser.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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
    for name, (place, drawn) in VIEWS.items():
        page = browser.page()
        page.call("Performance.enable")
        took = seconds_to(page, f"{base}{place}", drawn)
        page.call("HeapProfiler.collectGarbage")
        metrics = {one["name"]: one["value"] for one in page.call("Performance.getMetrics")["metrics"]}
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
        for name, (place, drawn) in VIEWS.items():
            took = seconds_to(page, f"{address.partition('?')[0]}{place}", drawn)
            report(f"served, again: {name}", f"{took:.2f} s")


def measure_export(browser: Any, run: str, folder: Path) -> None:
    """CPU seconds of an export without frames, and the views from its files."""
    began = time.process_time()
    page = write_viewer([open_run(run, allow_partial=True)], folder / "viewer", frames=False)
    report("export without frames", f"{time.process_time() - began:.0f} CPU-s")
    measure_views(browser, page.as_uri(), "file")


def main() -> None:
    """Print a line per measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="run with probes, such as that of full_run.py")
    parser.add_argument("--export", action="store_true", help="measure an exported folder too")
    options = parser.parse_args()
    tests = chromium_of_tests()
    if tests.CHROMIUM is None:
        sys.exit(tests.WHY_SKIPPED)
    with tempfile.TemporaryDirectory() as folder, tests.Browser(Path(folder) / "profile") as browser:
        measure_server(browser, options.run)
        if options.export:
            measure_export(browser, options.run, Path(folder))


if __name__ == "__main__":
    main()
