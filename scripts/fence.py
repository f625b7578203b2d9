"""Play a fixed set of small runs, and write every number that a user reads from them as one JSON file.

    python scripts/fence.py tests/acceptance/fence.json              # the default tests compare with it
    python scripts/fence.py --slow tests/acceptance/fence-slow.json  # more kinds, items and runs
    python scripts/fence.py --only recording,environment FILE        # some of the runs

Uses the command line and the names of `probe_kit.__all__` alone. The file maps run → table → row → column → value.
It holds no hash of settings and no folder. Arrays appear as a hash of their bytes, with mean and deviation.
"""

import os

PINNED = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    # One instruction set wherever there is AVX2: kernels for AVX-512 add numbers in another order.
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_CBWR": "AVX2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR",
}
os.environ.update({name: os.environ.get(f"FENCE_{name}", value) for name, value in PINNED.items()})

import argparse  # noqa: E402
import contextlib  # noqa: E402
import hashlib  # noqa: E402
import importlib.metadata  # noqa: E402
import io  # noqa: E402
import json  # noqa: E402
import platform  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import warnings  # noqa: E402
from collections.abc import Callable, Iterable, Mapping  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

import probe_kit as pk  # noqa: E402

Row = dict[str, Any]
Tables = dict[str, dict[str, Row]]

RENAMED: dict[str, str] = {}
"""Columns that the product has renamed since the file was made: the new name, and the name in the file."""

LEFT_OUT = {
    # Identities of settings and places, times.
    "settings", "key", "location", "weights_sha256", "suite", "probes", "created", "item_content_sha256",
    "seconds_inference", "seconds_simulation",
    # Sentences, whose numbers stand in columns of their own.
    "reason", "note", "rule_words", "left_out",
}  # fmt: skip

ROW_KEYS = (
    "episode_id", "label", "asked", "acted", "model", "other_model", "target", "category", "view", "stream",
    "site", "call", "sites", "role", "cells", "part", "direction", "coefficient", "is_control", "is_drawn",
    "block", "iteration", "head", "number", "source_episode", "frame", "row", "column", "name",
)  # fmt: skip
"""Columns that say what a row is about, in this order in its key."""


class Fence:
    """Numbers of the runs that were played in the working folder."""

    def __init__(self) -> None:
        self.runs: dict[str, Tables] = {}

    def add(self, run: str, table: str, records: Iterable[Mapping[str, Any]]) -> None:
        """Store records as the rows of a table. Raises SystemExit for a table without rows."""
        rows = self.runs.setdefault(run, {}).setdefault(table, {})
        for record in records:
            flat = flatten(record)
            key = " | ".join(f"{name}={flat[name]}" for name in ROW_KEYS if flat.get(name) not in (None, ""))
            twins = sum(other == key or other.startswith(f"{key} #") for other in rows)
            rows[f"{key} #{twins}" if twins else key or "all"] = flat
        if not rows:
            raise SystemExit(f"fence: {run} has no rows in the table {table!r}; expected at least one")


def flatten(record: Mapping[str, Any], before: str = "") -> Row:
    """Return the record with plain values and `outer.inner` for the names of nested records."""
    flat: Row = {}
    for name, value in record.items():
        if name in LEFT_OUT or name.startswith("settings"):
            continue
        full = f"{before}{RENAMED.get(name, name)}"
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{full}.")
        else:
            flat[full] = plain(value)
    return {name.removeprefix("run."): value for name, value in flat.items()}


def plain(value: Any) -> Any:
    """Return a value that JSON can hold; missing numbers are None."""
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if isinstance(value, Mapping):
        return flatten(value)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None if np.isnan(value) else str(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return None if str(value) in ("<NA>", "NaT") else str(value)


def fingerprint(array: NDArray[Any]) -> Row:
    """Return shape, a hash of the bytes, mean and standard deviation of an array."""
    array = np.ascontiguousarray(array)
    about = f"{array.dtype.str} {array.shape} ".encode()
    numbers = array.astype(np.float64)
    present = numbers[np.isfinite(numbers)]
    return {
        "shape": list(array.shape),
        "bytes_sha256": hashlib.sha256(about + array.tobytes()).hexdigest()[:16],
        "mean": float(present.mean()) if present.size else None,
        "deviation": float(present.std()) if present.size else None,
    }


# -- the product, as a user calls it -----------------------------------------------------------------------


def call(*arguments: object) -> str:
    """Run `probe-kit ARGUMENTS` in this process and return its stdout. Raises SystemExit unless it ends with 0."""
    from probe_kit.__main__ import main

    command, out = [str(argument) for argument in arguments], io.StringIO()
    print("fence: probe-kit", *command, file=sys.stderr, flush=True)
    before, sys.argv, code = sys.argv, ["probe-kit", *command], 0
    try:
        with contextlib.redirect_stdout(out):
            main()
    except SystemExit as ended:
        code = int(ended.code or 0)
    finally:
        sys.argv = before
    if code:
        raise SystemExit(f"fence: `probe-kit {' '.join(command)}` ended with {code}; expected 0\n{out.getvalue()}")
    return out.getvalue()


def table(*arguments: object) -> Any:
    """Run a command that prints JSON and return what it says."""
    return json.loads(call(*arguments, "--format", "json"))


def add_episodes(fence: Fence, name: str, run: pk.Run) -> None:
    """Store outcomes, and hashes of what moved."""
    fence.add(name, "episodes", run.episodes.to_dict("records"))
    steps = run.control_steps
    fence.add(name, "control steps", [{"row": "all", **fingerprint(steps), "steps": steps.tolist()}])
    if run.has_trajectories:
        for episode in run.episodes["episode_id"]:
            moved = run.trajectory(episode)
            records = [
                {"episode_id": episode, "column": part, **fingerprint(getattr(moved, part))}
                for part in ("commanded", "executed", "tool", "cube")
            ]
            fence.add(name, "trajectories", records)


def add_activations(fence: Fence, name: str, run: pk.Run, tokens: bool = False) -> None:
    """Store a hash of every stored column, and of all tokens where they are stored."""
    for stream in run.streams:
        for site in run.sites(stream):
            for inference in range(run.captured_calls):
                for view in run.views(stream, inference) if inference == 0 else ("mean",):
                    numbers = run.column(site, view, inference)
                    about = {"site": str(site), "view": view, "call": inference}
                    fence.add(name, "activations", [about | fingerprint(numbers)])
            if tokens:
                numbers, mask = run.tokens(site)
                about = {"site": str(site), "tokens_in_mask": int(mask.sum())}
                fence.add(name, "tokens", [about | fingerprint(numbers)])


def add_inputs(fence: Fence, name: str, run: pk.Run, *kinds: str) -> None:
    """Store hashes of what the model was shown and of what it predicted."""
    if run.inputs is None:
        raise SystemExit(f"fence: the run {name} stores no inputs; expected {', '.join(kinds)}")
    fence.add(name, "inputs", [{"row": kind, **fingerprint(run.inputs.read(kind))} for kind in kinds])


def add_probes(fence: Fence, name: str, title: str, results: Any) -> None:
    """Store the scores of every site."""
    fence.add(name, title, results.scores.to_dict("records"))


def add_retention(fence: Fence, name: str, title: str, *arguments: object, command: str = "retention") -> None:
    """Store every list of the command's JSON as a table."""
    printed = table(command, *arguments)
    if isinstance(printed, list):
        printed = {"rows": printed}
    for part, records in printed.items():
        if isinstance(records, list) and records:
            fence.add(name, f"{title}, {part}", [r if isinstance(r, dict) else {"row": r} for r in records])


def add_intervention(fence: Fence, name: str, folder: str, kind: str, *arguments: object) -> None:
    """Store the effects of an intervention, as printed and as Python loads them."""
    printed = table("intervene", folder, "--kind", kind, *arguments)
    effects, key = printed["effects"], printed["key"]
    loaded = pk.load_effects(pk.open_run(folder), key).table
    if len(loaded) != len(effects):
        raise SystemExit(f"fence: {kind} prints {len(effects)} rows; load_effects has {len(loaded)}")
    if kind == "attention":  # a row per head and iteration: thousands
        shares = np.array([row["share"] for row in effects])
        effects = [row for row in effects if row["iteration"] in (0, 9) and row["head"] == 0]
        fence.add(name, "attention, all", [{"row": "all", **fingerprint(shares)}])
    fence.add(name, kind, effects)


# -- the runs ----------------------------------------------------------------------------------------------

COLOR = ("--categories", "color", "--items", 12)
TWO = ("--categories", "color,state", "--items", 12)
SMALL = ("--env-workers", 1, "--frames", "none")
UNTRAINED, ASKED = "untrained", "asked/instruction-224x224"
CONTROLS = "position,instruction,pixels,random-features"


def play_scenes(fence: Fence) -> None:
    """Act, capture a random network, and ask the VLM: two categories of the scene."""
    acting = ("--max-steps", 5, "--captured-calls", 2, "--label", "acting")
    call("extract", "--model", "pi0-tiny", *TWO, *acting, *SMALL, "--out", "acting")
    random = ("--no-act", "--random-weights", "--label", "untrained")
    call("extract", "--model", "pi0-tiny", *COLOR, *random, *SMALL, "--out", UNTRAINED)
    asking = ("--prompt", "instruction", "--tokens", "all", "--label", "asked")
    call("ask", "--model", "vlm-tiny", *COLOR, *asking, *SMALL, "--out", "asked")
    for name, folder in (("acting", "acting"), ("untrained", UNTRAINED), ("asked", ASKED)):
        run = pk.open_run(folder)
        add_episodes(fence, name, run)
        add_activations(fence, name, run, tokens=name == "asked")


def probe_sides(fence: Fence) -> None:
    """Fit the probes of sides with every control."""
    run = pk.open_run("acting")
    against = ("--controls", CONTROLS, "--untrained", UNTRAINED)
    call("train", "acting", "--permutations", 20, "--categories", "color", *against)
    add_probes(fence, "acting", "sides", pk.load_results(run))
    call("train", ASKED, "--permutations", 20, "--views", "mean")
    add_probes(fence, "asked", "sides", pk.load_results(pk.open_run(ASKED)))


def decode_labels(fence: Fence) -> None:
    """Decode a continuous label, a binary one and classes."""
    run = pk.open_run("acting")
    for target, task, controls, permutations in (
        ("sim.tool_y", "continuous", ("step", "state"), 31),
        ("item.category", "binary", (), 3),
        ("item.category", "classes", ("instruction",), 7),
    ):
        options = ("--permutations", permutations, "--controls", ",".join(controls) or "none", "--task", task)
        call("train", "acting", "--target", target, *options)
        labels = pk.Target.of_run(run, target, task=task)
        results = pk.train_probes(run, target=labels, permutations=permutations, controls=controls)
        add_probes(fence, "acting", f"label {target}, {task}", results)
    add_retention(fence, "acting", "label retention", "acting", "--target", "sim.tool_y")


def compare_answers_and_actions(fence: Fence) -> None:
    """Compare the VLM's answers, the policy's probes and its actions."""
    of_vlms = ("--kind", "vlm-vla", "--details", "all")
    add_retention(fence, "comparison", "VLM and VLA", ASKED, "acting", *of_vlms, command="compare")
    # Cubes end within 1 cm of the middle, so that only small zones tell a radius from another.
    small_zones = ("--epsilons", "0.004,0.006,0.008", "--last-steps", 2)
    add_retention(fence, "acting", "retention in small zones", "acting", *small_zones)
    printed = table("compare", ASKED, "acting", "--kind", "stages")
    fence.add("comparison", "stages", printed if isinstance(printed, list) else [printed])


def intervene_on_scenes(fence: Fence) -> None:
    """Play every kind that few items can afford."""
    color = ("--categories", "color", "--items")
    add_intervention(fence, "acting", "acting", "image-swap", *color, 4)
    add_intervention(fence, "acting", "acting", "instruction-swap", *color, 2)
    places = ("--sites", "backbone.01", "--roles", "all,image")
    add_intervention(fence, "acting", "acting", "interchange", *color, 4, *places)
    steered = ("--sites", "backbone.02", "--roles", "language", "--controls", 1, "--coefficients", 2)
    add_intervention(fence, "acting", "acting", "steer", *color, 2, *steered)
    add_intervention(fence, "acting", "acting", "attention", *color, 2, "--roles", "image,language")


def show_recordings(fence: Fence) -> None:
    """Show frames of a LeRobotDataset that lerobot itself writes."""
    write_recording(Path("recording"), episodes=10, frames=4)
    source_options = ("--dataset", "recording", "--camera", "base=observation.images.top", "--select", "every:2")
    call(
        "extract",
        "--model",
        "pi0-tiny",
        *source_options,
        "--label",
        "recording",
        "--accept-units",
        "--out",
        "shown",
    )
    run = pk.open_run("shown")
    add_episodes(fence, "recording", run)
    add_activations(fence, "recording", run)
    add_inputs(fence, "recording", run, "state", "action", "prediction", "pixels", "columns")
    target = "dataset.next.reward"
    call("train", "shown", "--target", target, "--permutations", 31, "--controls", "step,state")
    labels = pk.Target.of_run(run, target)
    results = pk.train_probes(run, target=labels, permutations=31, controls=("step", "state"))
    add_probes(fence, "recording", f"label {target}", results)


def play_own_environment(fence: Fence) -> None:
    """Act in an environment of `fence_environment.py`."""
    acting = ("--env", "fence_environment:BlockTable", "--captured-calls", 2, "--execute", 2)
    call("extract", "--model", "pi0-tiny", *acting, "--label", "environment", "--out", "environment")
    run = pk.open_run("environment")
    add_episodes(fence, "environment", run)
    add_activations(fence, "environment", run)
    add_inputs(fence, "environment", run, "state", "action", "pixels")
    target = "env.away"
    call("train", "environment", "--target", target, "--permutations", 31)
    results = pk.train_probes(run, target=pk.Target.of_run(run, target), permutations=31)
    add_probes(fence, "environment", f"label {target}", results)
    add_retention(fence, "environment", "label retention", "environment", "--target", "env.away")


def write_recording(folder: Path, episodes: int, frames: int) -> None:
    """Write frames of coloured blocks with lerobot's own API."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    number = {"dtype": "float32", "shape": (1,), "names": None}
    features = {
        "observation.images.top": {
            "dtype": "image",
            "shape": (48, 64, 3),
            "names": ["height", "width", "channels"],
        },
        "observation.state": {"dtype": "float32", "shape": (8,), "names": [f"s{index}" for index in range(8)]},
        "action": {"dtype": "float32", "shape": (7,), "names": None},
        "next.reward": number,
    }
    data = LeRobotDataset.create("fence/recording", 5, features, root=folder, use_videos=False)
    drawn = np.random.default_rng(0)
    for episode in range(episodes):
        for frame in range(frames):
            picture = drawn.integers(0, 256, (48, 64, 3), dtype=np.uint8)
            left = 8 + 32 * (episode % 2)
            picture[16:32, left : left + 16] = (200, 30, 30)
            state = np.array([0.29, 0.01 * episode, 0.16 + 0.01 * frame, 0, 0, 0, 0, 1], np.float32)
            data.add_frame(
                {
                    "observation.images.top": picture,
                    "observation.state": state,
                    "action": np.full(7, 10 * episode + frame, np.float32),
                    "next.reward": np.array([(-1) ** episode + 0.1 * frame + 0.01 * episode], np.float32),
                    "task": f"Put the cube on the {('red', 'blue')[episode // 2 % 2]} shape",
                }
            )
        data.save_episode()
    data.finalize()


# -- the larger part ---------------------------------------------------------------------------------------


def play_more_kinds(fence: Fence) -> None:
    """Intervene by the dear kinds and on more items."""
    call("extract", "--model", "pi0-tiny", *TWO, "--max-steps", 10, "--label", "acting", *SMALL, "--out", "longer")
    run = pk.open_run("longer")
    add_episodes(fence, "longer", run)
    for target in ("side.chosen", "side.shuffled"):
        few = ("--permutations", 3, "--categories", "state", "--controls", "none", "--views", "mean,last")
        call("train", "longer", "--target", target, *few)
        add_probes(fence, "longer", f"sides, target {target}", pk.load_results(run, target=target))
    call("train", "longer", "--permutations", 20, "--controls", CONTROLS)
    color = ("--categories", "color", "--items")
    add_intervention(
        fence, "longer", "longer", "interchange", *color, 12, "--sites", "backbone.*", "--roles", "all"
    )
    within = ("--sites", "backbone.03", "--roles", "all", "--direction", "mean-difference:1", "--controls", 2)
    add_intervention(fence, "longer", "longer", "interchange", *color, 12, *within)
    add_intervention(fence, "longer", "longer", "image-swap", "--items", 12)
    cells = ("--sites", "kv.*", "--roles", "image,language")
    add_intervention(fence, "longer", "longer", "joint", *color, 6, *cells)
    add_intervention(fence, "longer", "longer", "attribution", *color, 6, "--sites", "backbone.*", "--controls", 5)
    add_intervention(fence, "longer", "longer", "erase", *color, 12, "--sites", "backbone.02", "--controls", 2)
    edit = ("--sites", "backbone.03", "--direction", "none", "--roles", "all")
    add_intervention(fence, "longer", "longer", "closed-loop", *color, 4, *edit)
    add_retention(fence, "longer", "retention", "longer", "--details", "all")
    rule = ("--rule", "box", "--last-steps", 3)
    add_retention(fence, "longer", "retention by the rule box", "longer", *rule)


def compare_two_policies(fence: Fence) -> None:
    """Compare two runs, transfer a label, and ask in several prompts."""
    for model in ("pi0-tiny", "pi0-tiny-state"):
        acting = ("--max-steps", 5, "--tokens", "all", "--label", model)
        call("extract", "--model", model, *TWO, *acting, *SMALL, "--out", f"two/{model}")
        views = ("--views", "mean", "--folds", "concepts", "--incomplete", "drop")
        call("train", f"two/{model}", "--permutations", 20, *views, "--controls", "position,instruction")
        run = pk.open_run(f"two/{model}")
        add_episodes(fence, model, run)
        add_activations(fence, model, run, tokens=True)
        add_probes(fence, model, "sides, folds of concepts", pk.load_results(run))
    policies = ("two/pi0-tiny", "two/pi0-tiny-state")
    add_retention(fence, "two policies", "retention", *policies, "--details", "all", command="compare")
    call("ask", "--model", "vlm-tiny", *TWO, "--prompt", "p1,seen", *SMALL, "--out", "two/asked")
    for folder in sorted(Path("two/asked").iterdir()):
        add_episodes(fence, f"asked {folder.name}", pk.open_run(folder))
    for score in ("text", "logits", "order-balanced"):
        typed = [*sorted(map(str, Path("two/asked").iterdir())), *policies, "--kind", "vlm-vla", "--score", score]
        add_retention(fence, "two policies", f"answers by {score}", *typed, command="compare")


STUDY = """
schema = 1
name = "fence"
out = "study"
[suite]
categories = ["Color", "State"]
items = 12
[models.base]
family = "pi0-tiny"
label = "base"
vlm = "reader"
[models.reader]
family = "vlm-tiny"
label = "reader"
[conditions.plain]
max_steps = 5
[conditions.dark]
max_steps = 5
light_level = 0.7
[asks.words]
prompt = "instruction"
[[runs]]
name = "main"
models = ["base"]
conditions = ["plain", "dark"]
[[runs]]
name = "vlms"
models = ["reader"]
asks = ["words"]
[probes.main]
runs = ["main"]
views = ["mean"]
permutations = 39
controls = ["random-features"]
[comparisons.light]
pairs = { conditions = ["plain", "dark"], models = ["base"] }
[tables.success]
kind = "success"
runs = ["main"]
[tables.sides]
kind = "sides"
runs = ["main"]
[tables.score]
kind = "score"
runs = ["main"]
[tables.light]
kind = "ablation"
comparison = "light"
[tables.probing]
kind = "probing"
runs = ["main"]
[tables.vlm-vla]
kind = "vlm-vla"
runs = ["main", "vlms"]
"""


def play_study(fence: Fence) -> None:
    """Play a little study and store each of its tables."""
    Path("fence.toml").write_text(STUDY, encoding="utf-8")
    call("study", "run", "fence.toml")
    for name in ("success", "sides", "score", "light", "probing", "vlm-vla"):
        printed = table("study", "table", "fence.toml", name)
        records = printed if isinstance(printed, list) else [printed]
        fence.add("study", name, [record if isinstance(record, dict) else {"row": record} for record in records])


Part = Callable[[Fence], None]
PARTS: dict[str, tuple[Part, ...]] = {
    "scenes": (play_scenes, probe_sides, decode_labels, compare_answers_and_actions, intervene_on_scenes),
    "recording": (show_recordings,),
    "environment": (play_own_environment,),
}
SLOW_PARTS: dict[str, tuple[Part, ...]] = {
    "kinds": (play_more_kinds,),
    "two": (compare_two_policies,),
    "study": (play_study,),
}


def numeric_platform() -> dict[str, str]:
    """Return what decides the last bits of a number: processor kind, instruction set and versions."""
    import torch
    from threadpoolctl import threadpool_info

    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []
    vendor = next((line.split(":")[1].strip() for line in lines if line.startswith("vendor_id")), "unknown")
    # Not scikit-learn: 1.8.0 and 1.9.1 give the same bits, in the default part and in `erase`, which calls it.
    names = ("torch", "numpy", "scipy", "pybullet", "pillow", "opencv-python-headless", "transformers", "lerobot")
    libraries = {
        f"{library['internal_api']} {library.get('version')} {library.get('architecture', '')}".strip()
        for library in threadpool_info()
        if library["user_api"] == "blas"
    }
    return {
        "machine": platform.machine(),
        "vendor": vendor,
        "libc": " ".join(platform.libc_ver()),
        "torch_capability": torch.backends.cpu.get_cpu_capability(),
        "blas": ", ".join(sorted(libraries)),
        **{name: importlib.metadata.version(name) for name in names},
    }


def as_text(platform_of: Mapping[str, str], runs: Mapping[str, Tables]) -> str:
    """Return the file's JSON with a line per row, so that a change of numbers is read line by line."""
    lines = ["{", f'"platform": {json.dumps(platform_of, indent=1)},', '"runs": {']
    run_blocks = []
    for run, tables in runs.items():
        table_blocks = []
        for title, rows in tables.items():
            body = [f"   {json.dumps(key)}: {json.dumps(row, ensure_ascii=False)}" for key, row in rows.items()]
            table_blocks.append(f"  {json.dumps(title)}: {{\n" + ",\n".join(body) + "\n  }")
        run_blocks.append(f" {json.dumps(run)}: {{\n" + ",\n".join(table_blocks) + "\n }")
    return "\n".join([*lines, ",\n".join(run_blocks), "}", "}"]) + "\n"


def main() -> None:
    """Play the parts in a temporary folder and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--slow", action="store_true", help="play the larger part in place of the default one")
    parser.add_argument("--only", default="", help="some parts, comma-separated")
    parser.add_argument("--runs", type=Path, help="an empty folder that keeps the runs")
    options = parser.parse_args()
    parts = SLOW_PARTS if options.slow else PARTS
    selected = options.only.split(",") if options.only else list(parts)
    if unknown := sorted(set(selected) - set(parts)):
        parser.error(f"--only names {', '.join(unknown)}; the parts are {', '.join(parts)}")
    file, fence = options.file.resolve(), Fence()
    warnings.simplefilter("ignore")
    import torch

    torch.set_num_threads(1)
    with contextlib.ExitStack() as stack:
        folder = (
            options.runs.resolve() if options.runs else Path(stack.enter_context(tempfile.TemporaryDirectory()))
        )
        folder.mkdir(exist_ok=True)
        stack.enter_context(contextlib.chdir(folder))
        os.environ["PROBE_KIT_CACHE"] = str(Path(folder, "cache"))
        os.environ["HF_HOME"] = str(Path(folder, "hugging-face"))
        for part in selected:
            for play in parts[part]:
                play(fence)
    file.write_text(as_text(numeric_platform(), fence.runs), encoding="utf-8")


if __name__ == "__main__":
    main()
