"""Train the embedded default from nothing: `uv run python scripts/train_pi0_tiny.py OUT`.

Records demonstrations, draws pictures, trains, and writes two checkpoints: `OUT/pi0-tiny` and, from early in
the same training, `OUT/pi0-tiny-early`. Called again it continues where it was stopped. Needs about an hour on
two CPU cores. Nothing of the evaluation split is used: other pictures, drawn from other seeds.
"""

from pathlib import Path
from typing import Annotated

import torch
import typer
from pi0_tiny_training.batches import UNUSED, Sampler, without_pictures
from pi0_tiny_training.checkpoint import measured_statistics, write_trained
from pi0_tiny_training.demonstrations import record
from pi0_tiny_training.heads import Heads
from pi0_tiny_training.painting import calibrate
from pi0_tiny_training.pictures import PictureBank
from pi0_tiny_training.training import STAGES, Trainer, follow

from probe_kit.env import SceneSpec
from probe_kit.hooks.pi0 import Pi0
from probe_kit.models.pi0_tiny import new_pi0_tiny, write_checkpoint

CATEGORIES = {"shape": 0.42, "color": 0.28, UNUSED: 0.30}
"""The share of each category in a batch."""
PICTURE_SEED = 715_517
"""The embedded suite is drawn from seed 0."""
EARLY_STEP = 300


def main(
    out: Annotated[Path, typer.Argument(help="Folder for data, training state and checkpoints.")],
    table_twins: Annotated[int, typer.Option(help="Demonstrations from the table, each to both sides.")] = 110,
    grasped_twins: Annotated[int, typer.Option(help="Demonstrations from the hand, each to both sides.")] = 24,
    couples: Annotated[int, typer.Option(help="Couples of pictures per category.")] = 4000,
    seed: Annotated[int, typer.Option(help="Seed of weights, batches and flow noise.")] = 0,
    threads: Annotated[int, typer.Option(help="Threads of torch; one is best beside other work.")] = 1,
) -> None:
    """Record, draw, train, write."""
    torch.set_num_threads(threads)
    out.mkdir(parents=True, exist_ok=True)
    brushes = calibrate(SceneSpec())
    recorded = record(
        out / "demonstrations.npz", range(table_twins), range(1000, 1000 + grasped_twins), 0.3, print
    )
    demonstrations = without_pictures(recorded, brushes)
    banks = []
    for category in CATEGORIES:
        path = out / f"pictures-{category}.npz"
        if not path.is_file():
            PictureBank.drawn(category, PICTURE_SEED, couples, brushes, print).save(path)
        banks.append(PictureBank.read(path))

    statistics = measured_statistics(demonstrations)
    start = out / "start"
    write_checkpoint(start, new_pi0_tiny(seed), statistics, f"random, seed {seed}")
    policy = Pi0.load(str(start))
    sampler = Sampler(demonstrations, banks, list(CATEGORIES.values()), brushes, policy)
    torch.manual_seed(seed)
    trainer = Trainer(policy, Heads(brushes), sampler, STAGES, seed, out)
    follow(
        trainer,
        out / "losses.csv",
        print,
        {EARLY_STEP: lambda: write_trained(out / "pi0-tiny-early", trainer, statistics)},
    )
    write_trained(out / "pi0-tiny", trainer, statistics)


if __name__ == "__main__":
    typer.run(main)
