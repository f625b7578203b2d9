"""Conversion of a pickled InternVLA-M1 checkpoint to one folder of safetensors.

    python -m probe_kit.hooks.families.internvla.convert RUN OUT

prints the sha256 that the weights keep: a run of the copy is a run of the original.
"""

import json
import shutil
import sys
from pathlib import Path

from safetensors.torch import save_file

from probe_kit._system.drafts import draft_of
from probe_kit.errors import CheckpointError, ProbeKitError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import side_files
from probe_kit.hooks.checkpoints.weights import SINGLE_FILE, Weights, read_weights
from probe_kit.hooks.families.internvla.checkpoint import Parts, find_parts
from probe_kit.models.internvla.config import DIMS_FILE, RUN_FILE
from probe_kit.models.statistics_choice import STATISTICS_FILE

PROVENANCE = "converted.json"
_RUN_FILES = (RUN_FILE, DIMS_FILE, STATISTICS_FILE)


def convert(checkpoint: str, out: Path, vlm: str | None = None) -> str:
    """Write `out` with the same tensors as safetensors, the run's files, and those of the vision-language model.

    checkpoint, vlm: as `load_internvla` takes them. Nothing of the pickle is executed.
    Returns the sha256 over (name, dtype, shape, bytes) of all tensors, the same before and after.
    Raises UsageError if `out` exists, CheckpointError and WeightsError for what cannot be read.
    """
    if out.exists():
        raise UsageError(f"{out} exists; name a folder that does not, so that nothing is overwritten")
    parts = find_parts(checkpoint, vlm)
    weights = parts.read()
    sha256 = weights.sha256()
    with draft_of(out) as draft:
        draft.mkdir()
        _write(parts, weights, draft)
        written = read_weights(draft).sha256()
        if written != sha256:
            raise CheckpointError(
                f"{draft} held weights {written}, {parts.weights} {sha256}; check the disk and try again"
            )
        source = {"weights": parts.weights.name, "weights_sha256": sha256}
        (draft / PROVENANCE).write_text(json.dumps(source, indent=2) + "\n", encoding="utf-8")
        draft.rename(out)
    return sha256


def _write(parts: Parts, weights: Weights, folder: Path) -> None:
    # Tied tensors share their memory in a pickle, which safetensors does not allow.
    save_file({name: value.clone().contiguous() for name, value in weights.tensors.items()}, folder / SINGLE_FILE)
    for name, file in side_files(parts.vlm).items():
        shutil.copyfile(file, folder / name)
    for name in _RUN_FILES:
        if (parts.run / name).is_file():
            shutil.copyfile(parts.run / name, folder / name)


def main(arguments: list[str]) -> int:
    """RUN and OUT, and perhaps the vision-language model's folder; the exit code of the command line."""
    if len(arguments) not in (2, 3):
        print(__doc__, file=sys.stderr)
        return 2
    try:
        print(convert(arguments[0], Path(arguments[1]), *arguments[2:]))
    except ProbeKitError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
