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
from pi0_tiny_training.checkpoint import draw_losses, measured_statistics, write_trained
from pi0_tiny_training.demonstrations import Demonstrations, Recording, record
from pi0_tiny_training.heads import Heads
from pi0_tiny_training.painting import Brush, calibrate
from pi0_tiny_training.pictures import PictureBank
from pi0_tiny_training.training import KICKED, STAGES, STEADY, Trainer, follow

from probe_kit.env import SceneSpec
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.models.pi0_tiny import new_pi0_tiny, write_checkpoint

CATEGORIES = {"shape": 0.42, "color": 0.28, UNUSED: 0.30}
"""The share of each category in a batch."""
PICTURE_SEED = 715_517
"""The embedded suite is drawn from seed 0."""
COUPLES = 4000
EARLY_STEP = 300
STEADY_RECORDINGS = (
    Recording(range(110), start_jitter=0.012, misled=0.3),
    Recording(range(1000, 1024), start_grasped=True),
)
KICKED_RECORDINGS = (Recording(range(2000, 2060), start_jitter=0.004, kicked=True),)


def main(
    out: Annotated[Path, typer.Argument(help="Folder for data, training state and checkpoints.")],
    seed: Annotated[int, typer.Option(help="Seed of weights, batches and flow noise.")] = 0,
    threads: Annotated[int, typer.Option(help="Threads of torch; one is best beside other work.")] = 1,
) -> None:
    """Record, draw, train, write."""
    torch.set_num_threads(threads)
    out.mkdir(parents=True, exist_ok=True)
    brushes = calibrate(SceneSpec())
    steady = without_pictures(record(out / "steady.npz", STEADY_RECORDINGS, print), brushes)
    kicked = without_pictures(record(out / "kicked.npz", KICKED_RECORDINGS, print), brushes)
    banks = [_bank(out / f"pictures-{category}.npz", category, brushes) for category in CATEGORIES]

    statistics = measured_statistics(steady)
    write_checkpoint(out / "start", new_pi0_tiny(seed), statistics, f"random, seed {seed}")
    policy = Pi0.load(str(out / "start"))
    shares = list(CATEGORIES.values())
    samplers = {
        STEADY: Sampler(steady, banks, shares, brushes, policy),
        KICKED: Sampler(Demonstrations.joined([steady, kicked]), banks, shares, brushes, policy),
    }
    torch.manual_seed(seed)
    trainer = Trainer(policy, Heads(brushes), samplers, STAGES, seed, out)
    early = {EARLY_STEP: lambda: write_trained(out / "pi0-tiny-early", trainer, statistics, torch.float16)}
    follow(trainer, out / "losses.csv", print, early)
    write_trained(out / "pi0-tiny", trainer, statistics)
    draw_losses(out / "losses.csv", out / "losses.png")


def _bank(path: Path, category: str, brushes: tuple[Brush, Brush]) -> PictureBank:
    """The pictures of a category, drawn on first use."""
    if not path.is_file():
        PictureBank.drawn(category, PICTURE_SEED, COUPLES, brushes, print).save(path)
    return PictureBank.read(path)


if __name__ == "__main__":
    typer.run(main)
