"""Make the embedded VLM from nothing: `uv run python scripts/train_vlm_tiny.py OUT`.

Draws pictures, trains, and writes `OUT/vlm-tiny`. Called again it continues where it was stopped. `OUT/time.json`
says how much processor time each part took. Nothing of the evaluation split is used: other pictures, drawn from
another seed.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import torch
import typer
from vlm_tiny_training.batches import Pairs
from vlm_tiny_training.painting import Surface, calibrate, sheet
from vlm_tiny_training.pictures import PictureBank, read_banks
from vlm_tiny_training.reading import READING, Learner
from vlm_tiny_training.spent import timed
from vlm_tiny_training.training import Trainer, draw_losses, follow, rank, together

from probe_kit.env import SceneSpec
from probe_kit.hooks.families.embedded import new_vlm_tiny, write_vlm_tiny

SHARES = {"color": 0.22, "shape": 0.32, "state": 0.22, "traffic": 0.24}
"""Of each category in a batch."""
PRESETS = ("bridge", "act2answer")
SHEETS = {"side by side": (480, 560)}
PICTURE_SEED = 715_517
COUPLES = 2_400
"""Of pictures per category."""


def main(
    out: Annotated[Path, typer.Argument(help="Folder for data, training state and the checkpoint.")],
    seed: Annotated[int, typer.Option(help="Seed of weights and batches.")] = 0,
    processes: Annotated[int, typer.Option(help="That share every batch; their number changes the result.")] = 2,
) -> None:
    """Draw, train, write."""
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    with timed(out, "pictures"):
        surfaces = {name: calibrate(SceneSpec.preset(name)) for name in PRESETS}
        surfaces |= {name: sheet(*size) for name, size in SHEETS.items()}
        banks = read_banks(out, tuple(SHARES), PICTURE_SEED, COUPLES, surfaces, processes, print)
    with timed(out, "training"):
        together(processes, lambda: _train(out, seed, banks, surfaces))
    draw_losses(out / "losses.csv", out / "losses.png")


def _train(out: Path, seed: int, banks: list[PictureBank], surfaces: Mapping[str, Surface]) -> None:
    """What every process does."""
    network = new_vlm_tiny(seed)
    start = out / f"start-{rank()}"
    write_vlm_tiny(start, network, f"random, seed {seed}")
    learner = Learner(network, start / "tokenizer.json", Pairs(banks, SHARES), surfaces)
    trainer = Trainer(learner, READING, seed, out / "training.pt")
    follow(trainer, out / "losses.csv", print)
    if rank() == 0:
        write_vlm_tiny(out / "vlm-tiny", network, f"trained, {trainer.step} steps, seed {seed}")


if __name__ == "__main__":
    typer.run(main)
