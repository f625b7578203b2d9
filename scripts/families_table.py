"""Make one table of all policy families from their tiny checkpoints, and write it into `docs/notes/families.md`.

    python scripts/families_table.py FOLDER

FOLDER gets the checkpoints, the suite, a study file with a model per family, and the study's runs. It is played by
`probe-kit study`, which also prints the table. The checkpoints have random weights: the table shows that every
family runs through the same commands, and no number in it is about a released model. A second table has the
weights of the released sizes, from networks on the meta device. To resume, run the same command again.
"""

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "notes" / "families.md"
ITEMS, STEPS, PERMUTATIONS = 24, 4, 79
_BLOCK = re.compile(
    r"(<!-- from scripts/families_table.py: (?P<name>[a-z]+) -->\n).*?(<!-- end of it -->)", re.DOTALL
)
_HEAD = f"""schema = 1
name = "families"
out = "runs"

[suite]
path = "suite"
categories = ["Color"]
items = {ITEMS}

[conditions.short]
max_steps = {STEPS}

[probes.main]
runs = ["main"]
views = ["mean"]
permutations = {PERMUTATIONS}

[tables.families]
kind = "probing"
runs = ["main"]
"""


def write_study(folder: Path) -> None:
    """`study.toml` with a model per family, beside the suite and the checkpoints."""
    # An installed package has a folder `tests` too, which would hide the one of this repository.
    own = ModuleType("tests")
    own.__path__ = [str(ROOT / "tests")]
    sys.modules["tests"] = own
    from probe_kit.suite import build_suite
    from tests.support.acting_checkpoints import FAMILIES

    suite = build_suite(folder / "suite", ["color"], ITEMS)
    text = [_HEAD]
    for name, tiny in FAMILIES.items():
        checkpoint = tiny.made(suite, folder / "checkpoints" / name)
        text.append(f'\n[models."{name}"]\nfamily = "{name}"\n')
        if checkpoint is not None:
            text.append(f'checkpoint = "{Path(checkpoint).relative_to(folder)}"\n')
        if tiny.options:
            options = ", ".join(f"{key} = {json.dumps(value)}" for key, value in tiny.options.items())
            text.append(f"options = {{ {options} }}\n")
    models = json.dumps(list(FAMILIES))
    text.append(f'\n[[runs]]\nname = "main"\nmodels = {models}\nconditions = ["short"]\n')
    (folder / "study.toml").write_text("".join(text), encoding="utf-8")


def study(folder: Path, *command: str) -> str:
    """What `probe-kit study` prints of the study in `folder`."""
    whole = (sys.executable, "-m", "probe_kit", "study", *command)
    return subprocess.run(whole, cwd=folder, check=True, stdout=subprocess.PIPE, encoding="utf-8").stdout


def one_row_each(table: str) -> str:
    """The rows of Color: with one category, the rows of means are the same."""
    rows = [line for line in table.splitlines() if line.startswith("|")]
    return "\n".join(row for row in rows if "| mean | mean |" not in row)


def weights_table() -> str:
    """Parameters of every policy's released or default size, and the memory that they alone take."""
    from probe_kit.hooks.registry import own_families

    lines = ["| family | million parameters | GB in float32 | GB in bfloat16 |", "|---|---|---|---|"]
    for name, family in own_families().items():
        if not family.acts or family.full_size is None or family.sizes:
            continue
        network = family.function("full_size")()
        parameters = sum(one.numel() for one in network.parameters())
        lines.append(f"| {name} | {parameters / 1e6:,.0f} | {parameters * 4e-9:.1f} | {parameters * 2e-9:.1f} |")
    return "\n".join(lines)


def filled(page: str, tables: Mapping[str, str]) -> str:
    """The page with these tables, by name of their block."""
    return _BLOCK.sub(lambda block: f"{block[1]}\n{tables[block['name']].strip()}\n\n{block[3]}", page)


def main() -> None:
    """Play the study and write the page."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "study.toml").exists():
        write_study(folder)
    study(folder, "run", "study.toml")
    table = study(folder, "table", "study.toml", "families", "--format", "markdown")
    note = (
        f"{ITEMS} items of Color in both layouts, {STEPS} control steps an episode, {PERMUTATIONS} permutations. "
        "n/a: the backbone's signal is not shown."
    )
    tables = {"study": f"{one_row_each(table)}\n\n{note}", "weights": weights_table()}
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8"), tables), encoding="utf-8")
    print("\n\n".join(tables.values()))


if __name__ == "__main__":
    main()
