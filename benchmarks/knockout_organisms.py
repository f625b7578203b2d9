"""How often does a knockout name what a policy reads, of policies whose reading is known by construction?

    python benchmarks/knockout_organisms.py FOLDER [--draws 20] [--first 0] [--items 12] [--organisms NAME;NAME]

A draw is a run of its own seed and controls of its own. Organisms are edits of the embedded policy, see
`tests/support/organisms.py`: it reads the picture in block 2, words only, the picture through the words, nothing.
A verdict is right if a role is said to be read where it is, in the right layers where the edit decides them.
Finished draws in FOLDER are read. A draw takes about 45 seconds of one core. Exits with 1 if any verdict is wrong.
"""

import argparse
from collections import Counter
from pathlib import Path

import tests_of_checkout  # noqa: F401

from probe_kit.intervene import Knockout, run_intervention
from probe_kit.intervene.kinds.knockout import by_role, layers_read
from tests.support.organisms import READERS, is_true_of, reader_run


def main() -> None:
    """Print a line for every organism and role."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="First draw, to share them between processes.")
    parser.add_argument("--items", type=int, default=12)
    parser.add_argument("--organisms", default=";".join(READERS))
    options = parser.parse_args()
    tally: dict[tuple[str, str], Counter[str]] = {}
    for draw in range(options.first, options.first + options.draws):
        for name in options.organisms.split(";"):
            edit, truth = READERS[name]
            out = options.folder / f"{name.replace(' ', '-')}-{draw}"
            run, load = reader_run(edit, out, draw, options.items)
            result = run_intervention(run, Knockout(seed=draw), load=load)
            read = {role: layers_read(rows) for role, rows in by_role(result.effects).items()}
            print(f"{draw} {name}: {read}", flush=True)
            for role, layers in truth.items():
                verdict = "right" if is_true_of(layers, read[role]) else f"wrong: {read[role]}"
                tally.setdefault((name, role), Counter())[verdict] += 1
    for (name, role), counts in tally.items():
        print(f"{name:30} {role:10} " + ", ".join(f"{count} {verdict}" for verdict, count in counts.items()))
    raise SystemExit(any(counts.keys() - {"right"} for counts in tally.values()))


if __name__ == "__main__":
    main()
