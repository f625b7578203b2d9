"""How often is a diagnosis right about organisms whose answer is known by construction?

    PYTHONPATH=. python benchmarks/diagnose_organisms.py FOLDER [--draws 20] [--first 0]
        [--frames 24] [--organisms deaf,blind]

A draw is a run of its own seed, whose frames and donors are fresh. Organisms are edits of the embedded policy, see
`tests/support/pi0_organisms.py`. A verdict is right, open, or wrong. Finished draws in FOLDER are read. Exits
with 1 if any verdict is wrong.
"""

import argparse
from collections import Counter
from pathlib import Path

from probe_kit.diagnose.choices import count_groups
from probe_kit.diagnose.diagnosis import diagnose_run
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.runs import Run
from tests.support.pi0_organisms import ORGANISMS, Organism, edited

TALLY = ("right", "open", "wrong")


def run_of(folder: Path, category: str, draw: int, frames: int) -> Run:
    """Return the run of one draw: captured only, both items of every group."""
    settings = ExtractSettings(
        "pi0-tiny",
        categories=(category,),
        items=2 * count_groups(frames),
        capture_only=True,
        env_workers=0,
        seed=draw,
    )
    return extract_run(settings, folder / f"{category}-{draw}")


def judged(verdict: str, truth: tuple[str, ...]) -> str:
    """Return whether a verdict is the truth; one that shows less is open, neither right nor wrong."""
    if verdict in truth:
        return "right"
    return "open" if verdict == "open" or (verdict, *truth) == ("moves", "decides") else "wrong"


def diagnose(organism: Organism, folder: Path, draw: int, frames: int, inside: bool) -> dict[str, str]:
    """Return the judgement of every input, and of where it is lost on the first draw."""
    number = list(ORGANISMS.values()).index(organism)
    diagnosis = diagnose_run(
        run_of(folder, organism.category, draw, frames),
        frames=frames,
        inputs=tuple(organism.truth),
        inside=inside,
        load=edited(organism.edit),
        # The weights that a diagnosis is stored under are those before the edit: the seed keeps organisms apart.
        seed=draw * len(ORGANISMS) + number,
    )
    judgements = {}
    for diagnosed in diagnosis.inputs:
        print(f"  {draw} {diagnosed.name}: {diagnosed.verdict}, {100 * diagnosed.share:.0f} %, {diagnosed.where}")
        judgements[diagnosed.name] = judged(diagnosed.verdict, organism.truth[diagnosed.name])
        if inside and (words := organism.where.get(diagnosed.name)):
            judgements[f"{diagnosed.name}, where"] = "right" if words in diagnosed.where else "wrong"
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
            judgements = diagnose(ORGANISMS[name], options.folder, draw, options.frames, inside)
            for claim, judgement in judgements.items():
                counts.setdefault((name, claim), Counter())[judgement] += 1
    print(f"{'organism':14} {'claim':22}" + "".join(f"{word:>8}" for word in TALLY))
    for (name, claim), tally in counts.items():
        print(f"{name:14} {claim:22}" + "".join(f"{tally[word]:8}" for word in TALLY))
    raise SystemExit(any(tally["wrong"] for tally in counts.values()))


if __name__ == "__main__":
    main()
