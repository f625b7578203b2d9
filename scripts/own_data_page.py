"""Make the table and the figure of `docs/own-data.md`: `python scripts/own_data_page.py FOLDER`.

FOLDER gets a run of `pi0-tiny` in scenes, the same frames as a LeRobotDataset that lerobot writes, a run on it,
and a table with a binary, a class and a continuous label, which are the state of the simulation. All figures and
the report of these labels go to FOLDER too.
"""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from lerobot.datasets.lerobot_dataset import LeRobotDataset

import probe_kit as pk
from probe_kit.extract.rollout.controllers import Inference, PolicyController, Turn
from probe_kit.hooks import Observation
from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention import retention_table
from probe_kit.retention.displays import collect_figures, layer_curve, save_figures
from probe_kit.retention.report import write_report
from probe_kit.train import ProbeResults
from probe_kit.train.builtin_columns import label_frame
from probe_kit.train.results.probe_results import exceeds_column

PAGE = Path(__file__).parents[1] / "docs" / "own-data.md"
FIGURE, FIGURE_DPI = PAGE.with_name("own-data.png"), 110
CAMERA, FPS, ITEMS, PERMUTATIONS = "observation.images.top", 1, 20, 200
LABELS = ("left", "where", "distance")
"""Columns of the table: whether the correct picture lies left, where the cube is, and how far from it."""
BETWEEN = (-0.06, 0.03)
"""World y in metres between which the cube is over neither picture."""
_BLOCK = re.compile(r"(<!-- from scripts/own_data_page.py -->\n).*?(<!-- end of it -->)", re.DOTALL)


def main() -> None:
    """Record, extract, label, train, and write the table into the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    scene, episodes = play(folder / "scene")
    write_data_set(folder / "kitchen", episodes)
    source = pk.LeRobotSource(str(folder / "kitchen"), cameras={"base": CAMERA})
    run = pk.extract_run(pk.ExtractSettings("pi0-tiny", source=source), folder / "own")
    table = own_table(run, scene)
    table.to_csv(folder / "labels.csv", index=False)
    results = [
        pk.train_probes(
            run, target=pk.Target.read(folder / "labels.csv", name, group_by="scene"), permutations=PERMUTATIONS
        )
        for name in LABELS
    ]
    retained = retention_table([run], target=LABELS)
    list(save_figures(collect_figures([run], retained), folder / "figures"))
    write_report([run], folder / "report.html", retained)
    layer_curve(results[0], iterations="best").savefig(FIGURE, dpi=FIGURE_DPI)
    filled = table_of(run, results)
    page = _BLOCK.sub(lambda block: f"{block[1]}\n{filled}\n\n{block[2]}", PAGE.read_text(encoding="utf-8"))
    PAGE.write_text(page, encoding="utf-8")


def play(where: Path) -> tuple[pk.Run, list[list[Observation]]]:
    """A run in scenes, and what the policy was shown at every inference of its episodes."""
    shown: dict[int, list[Observation]] = {}
    infer = PolicyController.infer

    def watched(self: PolicyController, turns: Sequence[Turn]) -> list[Inference]:
        for turn in turns:
            shown.setdefault(turn.row.policy_seed, []).append(turn.observation)
        return infer(self, turns)

    PolicyController.infer = watched  # type: ignore[method-assign]
    try:
        settings = pk.ExtractSettings(
            model="pi0-tiny", categories=("color",), items=ITEMS, captured_calls="all", picture_size=(320, 240)
        )
        run = pk.extract_run(settings, where)
    finally:
        PolicyController.infer = infer  # type: ignore[method-assign]
    return run, [shown[int(seed)] for seed in run.episodes["policy_seed"]]


def write_data_set(folder: Path, episodes: list[list[Observation]]) -> None:
    """The frames as a LeRobotDataset with pictures as PNG."""
    first = episodes[0][0]
    names = ["x", "y", "z", "roll", "pitch", "yaw", "none", "openness"]
    features: dict[str, Any] = {
        CAMERA: {"dtype": "image", "shape": first.image.shape, "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (8,), "names": names},
    }
    data = LeRobotDataset.create("local/kitchen", FPS, features, root=folder, use_videos=False)
    for episode in episodes:
        for seen in episode:
            data.add_frame({CAMERA: seen.image, "observation.state": seen.state, "task": seen.instruction})
        data.save_episode()
    data.finalize()


def own_table(run: pk.Run, scene: pk.Run) -> pd.DataFrame:
    """The table of `probe-kit labels`, with the simulation's state at the same frames and the item's group."""
    keys = ["source_episode", "inference"]
    there = label_frame(scene)
    numbers = {name: number for number, name in enumerate(scene.episodes["episode_id"])}
    there["source_episode"] = there["episode_id"].map(numbers)
    there["left"] = there["item.left"] == there["item.named"]
    cube = there["sim.cube_y"]
    there["where"] = np.select([cube > BETWEEN[1], cube < BETWEEN[0]], ["left", "right"], "middle")
    wanted = there[[*keys, "left", "where"]].assign(
        distance=there["sim.distance_correct"], scene=there["group_id"]
    )
    return label_frame(run).merge(wanted, on=keys, how="left")


def table_of(run: pk.Run, results: list[ProbeResults]) -> str:
    """The best site of every stream and label, as Markdown."""
    heads = ("label", "task", "stream", "best site", "score", "chance", "p", "exceeds every control")
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for found in results:
        scores = found.scores
        excess = scores["score"] - scores["chance"]
        for place in excess.groupby(scores["stream"], sort=False).idxmax():
            row = scores.loc[place]
            missed = [name for name in found.controls.names if not row[exceeds_column(name)]]
            cells = [
                f"`{found.settings.target}`",
                found.settings.task,
                label_of(row["stream"]),
                f"`{row['site']}`",
            ]
            cells += [f"{row['score']:.2f}", f"{row['chance']:.2f}", f"{row['p_fwe']:.3f}"]
            cells.append("yes" if not missed else "not " + ", ".join(f"`{name}`" for name in missed))
            rows.append(f"| {' | '.join(cells)} |")
    groups = int(results[0].scores["groups"].iloc[0])
    assert run.inputs is not None
    frames = int(np.isfinite(run.inputs.column("timestamp")).sum())
    note = (
        f"{len(run.episodes)} recorded episodes, {frames} frames, {groups} groups, {PERMUTATIONS} permutations. "
        "The score is balanced accuracy, or R² for `distance`."
    )
    return "\n".join(rows) + f"\n\n{note}"


if __name__ == "__main__":
    main()
