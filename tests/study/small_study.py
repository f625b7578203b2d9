"""A small study of embedded models: two networks that are captured, a VLM that is asked, probes."""

from pathlib import Path

from probe_kit.runs import open_run
from probe_kit.study import load_study
from probe_kit.suite import Suite
from tests.support.killed_commands import run_files

HEAD = """
schema = 1
name = "small"
out = "{out}"

[suite]
path = "{suite}"
categories = ["color"]
items = {items}

"""
TEXT = """
[models.first]
family = "pi0-tiny"
random_weights = true
untrained = "second"

[models.second]
family = "pi0-tiny"
random_weights = true
weights_seed = 1

[models.reader]
family = "vlm-tiny"

[conditions.still]
no_act = true

[conditions.dark]
no_act = true
light_level = 0.7

[asks.p1]
prompt = "p1"

[[runs]]
name = "main"
models = ["first", "second"]
conditions = ["still"]

[[runs]]
name = "light"
models = ["first"]
conditions = ["dark"]

[[runs]]
name = "vlms"
models = ["reader"]
asks = ["p1"]
tokens = "pooled"

[probes.main]
runs = ["main"]
permutations = 19
controls = ["untrained", "position"]

[tables.probing]
kind = "probing"
runs = ["main"]

[tables.vlms]
kind = "vlms"
runs = ["vlms"]
"""
EPISODES = 4 * 24
SCRIPTED = """
[models.expert]
family = "expert"

[models.idle]
family = "idle"

[conditions.plain]
max_steps = 2

[conditions.dark]
max_steps = 2
light_level = 0.7

[[runs]]
name = "main"
models = ["expert", "idle"]
conditions = ["plain", "dark"]

[tables.main]
kind = "success"
runs = ["main"]
"""
"""Without a network, so that twenty kills take minutes."""
LIGHT = """
[models.expert]
family = "expert"

[models.idle]
family = "idle"

[conditions.short]
max_steps = 1

[conditions.dark]
max_steps = 1
light_level = 0.7

[[runs]]
name = "main"
models = ["expert", "idle"]
conditions = ["short"]

[[runs]]
name = "light"
models = ["idle"]
conditions = ["dark"]

[comparisons.light]
pairs = {{ conditions = ["short", "dark"], models = ["idle"] }}

"""
"""Two scripted models and a dark scene for one of them, without tables."""


def small_study(folder: Path, suite: Suite, text: str = TEXT, items: int = 12) -> Path:
    """Its file in `folder`, the head of all and `text`; runs lie in `folder/out`."""
    file = folder / "study.toml"
    content = (HEAD + text).format(out=folder / "out", suite=suite.folder, items=items)
    file.write_text(content, encoding="utf-8")
    return file


def bytes_of(file: Path) -> dict[str, bytes]:
    """What its runs hold, without what may differ between two makings."""
    return {
        f"{folder.parent.name}/{folder.name}/{key}": content
        for folder in run_folders(file)
        for key, content in run_files(folder).items()
    }


def run_folders(file: Path) -> list[Path]:
    """Where the runs of a study lie."""
    study = load_study(file)
    return [Path(cell.location(study.study.folder)) for cell in study.cells]


def check_same_bytes(file: Path, other: Path) -> None:
    """Fail unless the runs of two studies have the same bytes, and one code of probe_kit has made both.

    A commit names the code that made it: a process that starts after an edit names another, with equal numbers.
    """
    runs = [open_run(folder) for study in (file, other) for folder in run_folders(study)]
    codes = {str(made_by["code_sha256"])[:12] for run in runs for made_by in run.provenances.values()}
    assert len(codes) == 1, f"probe_kit was edited while the studies played: {codes}; run the test again"
    assert bytes_of(file) == bytes_of(other)
