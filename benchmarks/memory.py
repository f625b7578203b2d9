"""What a simulator process holds over a whole study: resident memory as episodes pass.

    python benchmarks/memory.py [--episodes 3440] [--items 60] [--actions 1]

Every episode is set up, drawn and ended as `probe-kit extract` does it, by a policy that idles. Pictures are those
of the embedded suite, all categories, and come round again when the suite is through.
"""

import argparse
import tempfile
import time
from itertools import cycle, islice
from pathlib import Path

import tests_of_checkout  # noqa: F401

from probe_kit.env import SceneSpec
from probe_kit.extract.sources.scene_source import ScenePlayer
from probe_kit.extract.sources.source import Played
from probe_kit.suite import build_suite
from tests.support.plans import make_plan


def resident_megabytes() -> float:
    """Of this process."""
    return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]) * 4096 / 1e6


def main() -> None:
    """Print a line every now and then."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=3440)
    parser.add_argument("--items", type=int, default=60)
    parser.add_argument("--actions", type=int, default=1)
    parser.add_argument("--lines", type=int, default=17)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        suite = build_suite(Path(folder) / "suite", None, options.items)
        planned = make_plan(suite, [], 0, 1, True).episodes
        stage = ScenePlayer(SceneSpec(max_steps=options.actions), Played("ends", script="idle"))
        began, every = time.process_time(), max(1, options.episodes // options.lines)
        print(f"{len(planned)} episodes in the suite, {resident_megabytes():.0f} MB before the first", flush=True)
        for number, episode in enumerate(islice(cycle(planned), options.episodes), start=1):
            stage.begin(episode, film=False)
            if number % every == 0 or number in (1, 100, options.episodes):
                spent = (time.process_time() - began) / number
                print(
                    f"{number:5} episodes  {resident_megabytes():6.0f} MB  {1e3 * spent:.0f} CPU-ms each",
                    flush=True,
                )
        stage.close()


if __name__ == "__main__":
    main()
