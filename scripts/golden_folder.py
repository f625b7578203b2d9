"""The folder of a golden reference: a copy of the checkpoint, the recorded arrays, and a README."""

import argparse
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np


def reference_parser(description: str) -> argparse.ArgumentParser:
    """Return the parser of a recorder: CHECKPOINT FOLDER --seed N."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    return parser


def write_reference(
    checkpoint: Path, folder: Path, outputs: dict[str, np.ndarray], recorded: str, modules: Sequence[ModuleType]
) -> None:
    """Write the folder. recorded: its title and origin, in Markdown. modules: those whose versions it names."""
    shutil.copytree(checkpoint, folder / "checkpoint", dirs_exist_ok=True)
    np.savez_compressed(folder / "reference.npz", **outputs)
    versions = {module.__name__: module.__version__ for module in modules}
    text = f"# Golden reference: {recorded}. {json.dumps(versions)}\n"
    (folder / "README.md").write_text(text, encoding="utf-8")
