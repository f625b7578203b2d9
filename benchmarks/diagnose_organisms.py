"""How often is a diagnosis right about organisms whose answer is known by construction?

    python benchmarks/diagnose_organisms.py FOLDER [--draws 20] [--first 0]
        [--frames 24] [--organisms deaf,blind]

A draw is a run of its own seed, whose frames and donors are fresh. Organisms are edits of the embedded policy; for
the second camera, of a SmolVLA with random weights. See `tests/support/organisms.py`. A verdict is right, open, or
wrong. Finished draws in FOLDER are read. Exits with 1 if any verdict is wrong.
"""

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import tests_of_checkout  # noqa: F401
import torch

from probe_kit.diagnose.diagnosis import diagnose_run
from probe_kit.diagnose.inputs import frames_of
from probe_kit.diagnose.results import count_groups
from probe_kit.extract import EnvironmentSettings, ExtractSettings, extract_run
from probe_kit.hooks.families.pi0.adapter import load_pi0_tiny
from probe_kit.intervene.open_session import open_session
from probe_kit.intervene.sessions import ReplayFiles
from probe_kit.runs import Run
from probe_kit.suite import build_suite
from tests.support.acting_checkpoints import GOLDEN, knowing
from tests.support.organisms import FORGOT, ORGANISMS, TWO_CAMERAS, Edit, Organism, edited, forget_words

TALLY = ("right", "open", "wrong")
TUNING_SEED = 1_000_000
"""Of the scenes in which one organism forgets words: of no draw."""


def run_of(folder: Path, category: str, draw: int, frames: int) -> Run:
    """Return the run of one draw: captured only, both items of every group; or played in an environment."""
    if category == TWO_CAMERAS:
        return run_of_two_cameras(folder, draw, frames)
    settings = ExtractSettings(
        "pi0-tiny",
        categories=(category,),
        items=2 * count_groups(frames),
        capture_only=True,
        env_workers=0,
        seed=draw,
    )
    return extract_run(settings, folder / f"{category}-{draw}")


def run_of_two_cameras(folder: Path, draw: int, frames: int) -> Run:
    """Return the run of a SmolVLA with random weights, which is shown two cameras."""
    reference = folder / "smolvla"
    if not reference.exists():
        knowing(GOLDEN / "smolvla", build_suite(folder / "suite", ["color"], 24), reference)
    options = {"count": frames, "first": draw * frames}
    source = EnvironmentSettings("tests.support.reach_env:TwoCameras", options, max_steps=1)
    checkpoint = str(reference / "checkpoint")
    settings = ExtractSettings(
        "smolvla", checkpoint, source=source, execute=1, env_workers=0, accept_units=True, seed=draw
    )
    return extract_run(settings, folder / f"two-cameras-{draw}")


def edit_of(organism: Organism, folder: Path, frames: int) -> Edit:
    """Return the edit of an organism; of the one that is trained, the edit that loads its weights."""
    if organism is not ORGANISMS[FORGOT]:
        return organism.edit
    file = folder / "forgot.pt"
    if not file.exists():
        run, tuned = run_of(folder, "color", TUNING_SEED, frames), load_pi0_tiny()
        with open_session(run, ReplayFiles()) as session, session.ready():
            forget_words(tuned, [frame.observation for frame in frames_of(session, 4 * frames)])
        torch.save(tuned.network.state_dict(), file)
    return lambda policy: policy.network.load_state_dict(torch.load(file))


def judged(answer: str, truth: Sequence[str]) -> str:
    """Return whether a verdict or a change is the truth; one that shows less is open, neither right nor wrong."""
    if answer in truth:
        return "right"
    return "open" if answer == "open" or (answer, *truth) == ("moves", "decides") else "wrong"


def diagnose(name: str, folder: Path, draw: int, frames: int, inside: bool) -> dict[str, str]:
    """Return the judgement of every input, of where it is lost on the first draw, and of its change."""
    organism = ORGANISMS[name]
    diagnosis = diagnose_run(
        run_of(folder, organism.category, draw, frames),
        frames=frames,
        inputs=tuple(organism.truth),
        inside=inside,
        load=edited(edit_of(organism, folder, frames)),
        base="as shipped" if organism.changes else None,
        # The weights that a diagnosis is stored under are those before the edit: the seed keeps organisms apart.
        seed=draw * len(ORGANISMS) + list(ORGANISMS).index(name),
    )
    judgements = {}
    for diagnosed in diagnosis.inputs:
        print(f"  {draw} {diagnosed.name}: {diagnosed.verdict}, {100 * diagnosed.share:.0f} %, {diagnosed.where}")
        judgements[diagnosed.name] = judged(diagnosed.verdict, organism.truth[diagnosed.name])
        if inside and (words := organism.where.get(diagnosed.name)):
            judgements[f"{diagnosed.name}, where"] = "right" if words in diagnosed.where else "wrong"
        if diagnosed.base is not None:
            base, truth = diagnosed.base, organism.changes[diagnosed.name]
            print(f"    {base.change}: {100 * base.difference:.0f} %, p {base.p:.2g}")
            judgements[f"{diagnosed.name}, change"] = judged(base.change, truth)
    return judgements


def main() -> None:
    """Print a line for every organism and input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="First draw, to share them between processes.")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--organisms", default=",".join(ORGANISMS))
    options = parser.parse_args()
    counts: dict[tuple[str, str], Counter[str]] = {}
    for draw in range(options.first, options.first + options.draws):
        for name in options.organisms.split(","):
            inside = draw == 0 and bool(ORGANISMS[name].where)
            print(name, flush=True)
            judgements = diagnose(name, options.folder, draw, options.frames, inside)
            for claim, judgement in judgements.items():
                counts.setdefault((name, claim), Counter())[judgement] += 1
    print(f"{'organism':14} {'claim':22}" + "".join(f"{word:>8}" for word in TALLY))
    for (name, claim), tally in counts.items():
        print(f"{name:14} {claim:22}" + "".join(f"{tally[word]:8}" for word in TALLY))
    raise SystemExit(any(tally["wrong"] for tally in counts.values()))


if __name__ == "__main__":
    main()
