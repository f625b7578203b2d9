"""Make the embedded policies from the embedded VLM: `uv run python scripts/train_embedded_policy.py OUT`.

Records demonstrations in the released protocol's scene, draws pictures, gives `vlm-tiny`'s backbone an action
expert, and trains both to act. Writes `OUT/pi0-tiny`; `OUT/pi0-tiny-state`, which differs in one thing, that
its actions follow State too; and `OUT/pi0-tiny-early`, which has the VLM's backbone and has not learnt to act.
Called again it continues where it was stopped.
`OUT/time.json` says how much processor time each part took. Nothing of the evaluation split is used: other
pictures, drawn from another seed.
"""

from collections.abc import Callable, Mapping
from functools import partial
from itertools import batched
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import torch
import typer
from acting_training.acting import LEFT_OPEN, UNDERSTANDING, Actor, Followed, acting
from acting_training.checkpoint import measured_statistics, start_of_policy
from acting_training.demonstrations import record, training_scene
from acting_training.frames import Frames
from vlm_tiny_training.batches import Pairs
from vlm_tiny_training.painting import calibrate
from vlm_tiny_training.pictures import read_banks
from vlm_tiny_training.spent import timed
from vlm_tiny_training.training import Trainer, draw_losses, follow

from probe_kit.hooks.families.embedded import Statistics, write_checkpoint
from probe_kit.hooks.families.pi0.adapter import Pi0

SHARES = {"color": 0.36, "shape": 0.42, LEFT_OPEN: 0.22}
"""Of each category in a batch."""
TABLE = "table"
PICTURE_SEED = 715_517
COUPLES, COUPLES_LEFT_OPEN = 10_200, 3_600
"""Of pictures per category. The actions of State follow from few."""
DEMONSTRATIONS = range(90)
BATCH = 32
COMMON = "common"
BRANCHES: dict[str, Followed] = {"pi0-tiny": "random", "pi0-tiny-state": "always"}


def main(
    out: Annotated[Path, typer.Argument(help="Folder for data, training state and checkpoints.")],
    seed: Annotated[int, typer.Option(help="Seed of weights, batches and flow noise.")] = 0,
    threads: Annotated[int, typer.Option(help="Of torch.")] = 1,
    processes: Annotated[int, typer.Option(help="That record, draw, and train a branch each.")] = 1,
) -> None:
    """Record, draw, train, write."""
    torch.set_num_threads(threads)
    out.mkdir(parents=True, exist_ok=True)
    with timed(out, "data"):
        surface = calibrate(training_scene())
        demonstrations = record(out / "demonstrations.npz", DEMONSTRATIONS, processes, print)
        surfaces, acted = {TABLE: surface}, tuple(category for category in SHARES if category != LEFT_OPEN)
        banks = read_banks(out, acted, PICTURE_SEED, COUPLES, surfaces, processes, print)
        banks += read_banks(out, (LEFT_OPEN,), PICTURE_SEED, COUPLES_LEFT_OPEN, surfaces, processes, print)
    frames, statistics = Frames(TABLE, surface, demonstrations), measured_statistics(demonstrations)
    start = start_of_policy(out / "start", seed, statistics)
    _write(out / "pi0-tiny-early", start, statistics, f"not yet, seed {seed}", torch.float16)

    def train(name: str, followed: Followed) -> None:
        torch.set_num_threads(threads)
        _train(out, name, followed, seed, Pairs(banks, SHARES), frames, statistics)

    with timed(out, "common part"):
        _at_once(processes, train, {COMMON: "not at all"})
    with timed(out, "branches"):
        _at_once(processes, train, BRANCHES)


def _at_once(processes: int, train: Callable[[str, Followed], None], parts: Mapping[str, Followed]) -> None:
    """Train the parts in processes of their own, forked from one that never trained: torch asks for that."""
    for group in batched(parts.items(), processes):
        running = [get_context("fork").Process(target=train, args=part) for part in group]
        for process in running:
            process.start()
        for process in running:
            process.join()
        if any(process.exitcode for process in running):
            raise typer.Exit(1)


def _train(
    out: Path,
    name: str,
    followed: Followed,
    seed: int,
    pairs: Pairs,
    frames: Frames,
    statistics: Statistics,
) -> None:
    """The common part, from the VLM; or a branch, from the common part."""
    policy = Pi0.load(str(out / "start"))
    actor = Actor(policy, pairs, frames)
    branches = name != COMMON
    if branches:
        common = torch.load(out / f"{COMMON}.pt", weights_only=True)
        actor.network.load_state_dict(common["network"])
    stages = acting(followed) if branches else UNDERSTANDING
    trainer = Trainer(actor, stages, seed + int(branches), out / f"{name}.pt", BATCH)
    follow(trainer, out / f"{name}.csv", partial(print, flush=True))
    draw_losses(out / f"{name}.csv", out / f"{name}.png", BATCH)
    if branches:
        dtype = torch.float32 if name == "pi0-tiny" else torch.float16
        _write(out / name, policy, statistics, f"{followed}, {trainer.step} steps, seed {seed}", dtype)


def _write(folder: Path, policy: Pi0, statistics: Statistics, note: str, dtype: torch.dtype) -> None:
    write_checkpoint(folder, policy.network, statistics, f"vlm-tiny, trained to act: {note}", dtype)


if __name__ == "__main__":
    typer.run(main)
