"""The moving picture of README and viewer page: one episode in the viewer, step by step, in a real Chromium.

    probe-kit extract --model pi0-tiny --frames all --captured-calls all --out RUN
    probe-kit train RUN --call all
    python scripts/viewer_gif.py RUN --episode 74

An episode is worth a picture in which a log-odds changes its sign while the arm moves.
"""

import argparse
import sys
import tempfile
from importlib.util import module_from_spec, spec_from_file_location
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

from probe_kit import open_run
from probe_kit.view import write_viewer

ROOT = Path(__file__).parents[1]
TARGET = ROOT / "docs" / "viewer.gif"
WINDOW, SIZE = (1400, 940), (860, 577)
COLORS = 128
FIRST_MS, STEP_MS, LAST_MS = 900, 280, 1500


def film_episode(page: Any, address: str, episode: int) -> list[Image.Image]:
    """The window at every control step of an episode. page: of the browser of the tests."""
    page.open(f"{address}#/episodes?ep={episode}&t=0")
    page.read("new Promise(done => setTimeout(done, 400))")  # the film's picture is decoded
    last = int(page.read("document.querySelector('.scrub input').max"))
    pictures = []
    for _ in range(last + 1):
        screenshot = Image.open(BytesIO(page.picture(full_page=False))).convert("RGB")
        pictures.append(screenshot.crop((0, 0, WINDOW[0], round(WINDOW[0] * SIZE[1] / SIZE[0]))))
        page.press("ArrowRight")
    return pictures


def save_film(pictures: list[Image.Image], target: Path) -> None:
    """Write the pictures as one GIF that rests at its ends."""
    small = [
        picture.resize(SIZE, Image.Resampling.LANCZOS).quantize(
            COLORS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE
        )
        for picture in pictures
    ]
    pauses = [FIRST_MS, *[STEP_MS] * (len(small) - 2), LAST_MS]
    small[0].save(target, save_all=True, append_images=small[1:], duration=pauses, loop=0, optimize=True)


def tests_browser() -> Any:
    """The module that drives Chromium for the tests, which are no package."""
    spec = spec_from_file_location("browser", ROOT / "tests" / "support" / "browser.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main() -> None:
    """Export the run, film the episode and write the GIF."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="run with probes")
    parser.add_argument("--episode", type=int, default=0, help="its number, as the viewer lists it")
    parser.add_argument("--out", type=Path, default=TARGET)
    options = parser.parse_args()
    browser = tests_browser()
    if browser.CHROMIUM is None:
        sys.exit(browser.WHY_SKIPPED)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        page = write_viewer([open_run(options.run, allow_partial=True)], Path(folder) / "viewer")
        with browser.Browser(Path(folder) / "profile") as chromium:
            pictures = film_episode(chromium.page(*WINDOW), page.as_uri(), options.episode)
    save_film(pictures, options.out)
    print(f"{options.out}: {len(pictures)} steps, {options.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
