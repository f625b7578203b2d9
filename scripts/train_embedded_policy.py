"""Make the embedded policies from the embedded reader: `uv run python scripts/train_embedded_policy.py OUT`.

Records demonstrations in the released protocol's scene, draws pictures, gives `vlm-tiny`'s backbone an action
expert, and trains both to act. Writes `OUT/pi0-tiny`; `OUT/pi0-tiny-state`, which differs in one thing, that
its actions follow State too; and `OUT/pi0-tiny-early`. Called again it continues where it was stopped.
`OUT/time.json` says how much processor time each part took. Nothing of the evaluation split is used: other
pictures, drawn from another seed.
"""

from pathlib import Path
from typing import Annotated

import torch
import typer
from acting_training.acting import LEFT_OPEN, UNDERSTANDING, Actor, Followed, acting
from acting_training.checkpoint import measured_statistics, start_of_policy
from acting_training.demonstrations import Demonstrations, record, training_scene
from acting_training.frames import Frames
from vlm_tiny_training.batches import Pairs
from vlm_tiny_training.painting import calibrate
from vlm_tiny_training.pictures import PictureBank, read_banks
from vlm_tiny_training.spent import timed
from vlm_tiny_training.training import Trainer, draw_losses, follow

from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.models.pi0_tiny import write_checkpoint

SHARES = {"color": 0.28, "shape": 0.42, LEFT_OPEN: 0.30}
"""Of each category in a batch."""
TABLE = "table"
PICTURE_SEED = 715_517
COUPLES = {1: 1200, 2: 2400}
"""By version of the suite's pictures."""
DEMONSTRATIONS = range(90)
BATCH = 32
EARLY_STEP = 100
BRANCHES: dict[str, Followed] = {"pi0-tiny": "by lot", "pi0-tiny-state": "always"}


def main(
    out: Annotated[Path, typer.Argument(help="Folder for data, training state and checkpoints.")],
    seed: Annotated[int, typer.Option(help="Seed of weights, batches and flow noise.")] = 0,
    threads: Annotated[int, typer.Option(help="Of torch.")] = 1,
    processes: Annotated[int, typer.Option(help="That record and draw.")] = 1,
) -> None:
    """Record, draw, train, write."""
    torch.set_num_threads(threads)
    out.mkdir(parents=True, exist_ok=True)
    with timed(out, "data"):
        surface = calibrate(training_scene())
        demonstrations = record(out / "demonstrations.npz", DEMONSTRATIONS, processes, print)
        banks = read_banks(out, tuple(SHARES), PICTURE_SEED, COUPLES, {TABLE: surface}, processes, print)
    frames = Frames(TABLE, surface, demonstrations)
    with timed(out, "common part"):
        _train(out, "common", "not at all", seed, banks, frames, demonstrations)
    for name, followed in BRANCHES.items():
        with timed(out, name):
            _train(out, name, followed, seed, banks, frames, demonstrations)


def _train(
    out: Path,
    name: str,
    followed: Followed,
    seed: int,
    banks: list[PictureBank],
    frames: Frames,
    demonstrations: Demonstrations,
) -> None:
    """The common part, from the reader; or a branch, from the common part."""
    statistics = measured_statistics(demonstrations)
    policy = start_of_policy(out / "start", seed, statistics)
    actor = Actor(policy, Pairs(banks, SHARES), frames)
    common = out / "common.pt"
    branches = name != "common"
    if branches:
        actor.network.load_state_dict(torch.load(common, weights_only=True)["network"])
    stages = acting(followed) if branches else UNDERSTANDING
    trainer = Trainer(actor, stages, seed + int(branches), out / f"{name}.pt", BATCH)

    def early() -> None:
        _write(out / "pi0-tiny-early", policy, demonstrations, f"{trainer.step} steps, seed {seed}", torch.float16)

    follow(trainer, out / f"{name}.csv", print, {} if branches else {EARLY_STEP: early})
    draw_losses(out / f"{name}.csv", out / f"{name}.png", BATCH)
    if branches:
        _write(out / name, policy, demonstrations, f"{followed}, {trainer.step} steps, seed {seed}", torch.float32)


def _write(folder: Path, policy: Pi0, demonstrations: Demonstrations, note: str, dtype: torch.dtype) -> None:
    write_checkpoint(
        folder, policy.network, measured_statistics(demonstrations), f"vlm-tiny, trained to act: {note}", dtype
    )


if __name__ == "__main__":
    typer.run(main)
