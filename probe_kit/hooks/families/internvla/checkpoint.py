"""The files of InternVLA-M1: parts of a run, loading, and conversion of a pickled checkpoint to safetensors.

    python -m probe_kit.hooks.families.internvla.checkpoint RUN OUT

prints the sha256 that the weights keep: a run of the copy is a run of the original.
"""

import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors.torch import save_file

from probe_kit._system.bounded_files import load_json
from probe_kit._system.drafts import draft_of
from probe_kit.errors import CheckpointError, ProbeKitError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import INDEX_FILE, PATTERNS, WEIGHTS_FILE, hub_files, side_files
from probe_kit.hooks.checkpoints.folders import adapter_in, checkpoint_folder
from probe_kit.hooks.checkpoints.weights import (
    Weights,
    read_pickle,
    read_weights,
    with_adapter,
)
from probe_kit.hooks.families.internvla.network import DIMS_FILE, RUN_FILE, InternVLAConfig, find_config
from probe_kit.models.checkpoint_files import STATISTICS_FILE, stored_statistics

WEIGHTS_FOLDER = "checkpoints"
RELEASED_STEP = "steps_50000_pytorch_model.pt"
"""The file that Act2Answer's evaluation loads, and the one that is read where there are several."""
_VLM_TYPE = "qwen2_5_vl"
_VLM_PATTERNS = ("*.json", "*.txt", "*.jinja")
_DEVELOPMENT = "qwen2_5_vl_config"
"""The key under which development references keep the configuration of their small vision-language model."""


@dataclass(frozen=True)
class Parts:
    """The files and folders of a checkpoint.

    Attributes:
        run: The folder of config.yaml and the statistics.
        weights: A .pt file, or a folder of safetensors.
        vlm: The folder of the vision-language model's configuration, tokenizer and processor.
    """

    config: InternVLAConfig
    run: Path
    weights: Path
    vlm: Path

    def read(self) -> Weights:
        """Read the tensors.

        Raises:
            WeightsError: For a file that is missing or damaged.
            CheckpointError: For an adapter beside a `.pt` file.
        """
        adapter = adapter_in(self.run)
        if adapter is None:
            return _read(self.weights)
        if self.weights.is_file():
            raise CheckpointError(
                f"{self.run} holds a LoRA adapter beside {self.weights.name}: nothing says whether that file is "
                "merged. Merge the adapter with peft and pass the merged folder, or remove the adapter's files"
            )
        base = adapter.base_folder()
        return read_weights(base) if base == self.run else with_adapter(_read(_weights(base, None, None)), adapter)

    def statistics(self) -> Mapping[str, Any]:
        """Return per data set the statistics that un-normalise its actions; empty without the file."""
        return stored_statistics((self.run,), {}, str(self.run))[0]


def _read(path: Path) -> Weights:
    return read_pickle(path) if path.is_file() else read_weights(path)


def find_parts(checkpoint: str, vlm: str | None, weights: str | None = None, unread: bool = False) -> Parts:
    """Find the parts of a run's folder, its `checkpoints/`, one `.pt` file of it, a converted folder, or a hub id.

    Args:
        checkpoint: The folder, file or hub id.
        vlm: Folder or hub id of the vision-language model's files; None takes what the run's configuration names.
        weights: Name of a step's file; None takes the only one, or `RELEASED_STEP` among several. No other is
            downloaded.
        unread: Whether no weights will be read, so that none are looked for.

    Raises:
        CheckpointError: For a part that is missing or ambiguous, which it names.
    """
    path = Path(checkpoint).expanduser()
    if path.is_file():
        folder, file = path.parent, path
    else:
        folder = checkpoint_folder(checkpoint, (*PATTERNS, "*.yaml"))
        file = folder if unread else _weights(folder, weights, None if path.is_dir() else checkpoint)
    values, run = find_config(folder)
    where, content = _vlm(values, run, vlm)
    return Parts(InternVLAConfig.from_values(values, content, str(run)), run, file, where)


def _weights(folder: Path, file_name: str | None, hub: str | None) -> Path:
    """Return safetensors beside the configuration, or a .pt file there or in `checkpoints/`.

    Args:
        folder: The folder of the checkpoint.
        file_name: Name of a .pt file; None for the only one.
        hub: The hub id from which a .pt file is downloaded; None for a folder here.
    """
    if file_name is None and hub is None and adapter_in(folder) is not None and not any(folder.glob("**/*.pt")):
        return folder
    for candidate in (folder, folder / WEIGHTS_FOLDER):
        if file_name is None and ((candidate / WEIGHTS_FILE).is_file() or (candidate / INDEX_FILE).is_file()):
            return candidate
    if hub is not None:
        name = _select_file([name for name in hub_files(hub) if name.endswith(".pt")], file_name, hub)
        return checkpoint_folder(hub, (name,)) / name
    inside = folder.glob(f"{WEIGHTS_FOLDER}/*.pt")
    files = sorted(path.relative_to(folder).as_posix() for path in (*folder.glob("*.pt"), *inside))
    return folder / _select_file(files, file_name, str(folder))


def _select_file(files: Sequence[str], name: str | None, location: str) -> str:
    """The path of one .pt file among `files`, by its name.

    Raises:
        CheckpointError: If there is none, and if there are several.
    """
    by_name = {Path(file).name: file for file in files}
    listed = ", ".join(sorted(by_name))
    if not files:
        raise CheckpointError(
            f"no weights in {location} or its {WEIGHTS_FOLDER}/: expected {WEIGHTS_FILE} or a .pt file"
        )
    if name is not None:
        if name not in by_name:
            raise CheckpointError(f"{location} has no weights {name!r}; choose -M weights among {listed}")
        return by_name[name]
    if len(files) == 1:
        return files[0]
    if RELEASED_STEP not in by_name:
        raise CheckpointError(
            f"{location} holds several weights: {listed}. Name one with "
            "-M weights=FILE, or pass one as --checkpoint"
        )
    return by_name[RELEASED_STEP]


def _vlm(values: Mapping[str, Any], run: Path, vlm: str | None) -> tuple[Path, Mapping[str, Any]]:
    """Return folder and configuration of the vision-language model."""
    if vlm is None and _DEVELOPMENT in values:
        return run, values[_DEVELOPMENT]
    folder = run if vlm is None and _is_vlm(run) else _vlm_folder(values, run, vlm)
    if not _is_vlm(folder):
        raise CheckpointError(
            f"{folder} has no config.json of a {_VLM_TYPE} model; InternVLA-M1 is made of Qwen2.5-VL. "
            "Name that model's folder with -M vlm=DIR"
        )
    return folder, load_json(folder / "config.json")


def _vlm_folder(values: Mapping[str, Any], run: Path, vlm: str | None) -> Path:
    """Return the folder of `vlm`, or of what config.yaml names.

    Either is a folder, which may be relative to the run, or a model of the hub.

    Raises:
        CheckpointError: If neither names one.
    """
    base = vlm or str(((values.get("framework") or {}).get("qwenvl") or {}).get("base_vlm", ""))
    if not base:
        raise CheckpointError(f"{run} names no vision-language model; pass its folder with -M vlm=DIR")
    for folder in (Path(base).expanduser(), run / base):
        if folder.is_dir():
            return folder
    # The authors' own folders end in the name the model has on the hub.
    name = Path(base).name
    hub = base if base.count("/") == 1 and not base.startswith((".", "/")) else f"Qwen/{name}"
    return checkpoint_folder(hub, _VLM_PATTERNS)


def _is_vlm(folder: Path) -> bool:
    file = folder / "config.json"
    return file.is_file() and load_json(file).get("model_type") == _VLM_TYPE


# -- conversion -----------------------------------------------------------------------------------------------

PROVENANCE = "converted.json"
_RUN_FILES = (RUN_FILE, DIMS_FILE, STATISTICS_FILE)


def convert(checkpoint: str, out: Path, vlm: str | None = None) -> str:
    """Write `out` with the same tensors as safetensors, the run's files, and those of the vision-language model.

    Nothing of the pickle is executed.

    Args:
        checkpoint: The checkpoint as `load_internvla` takes it.
        out: The new folder.
        vlm: Folder or hub id of the vision-language model's files; None takes what the run's configuration names.

    Returns:
        The sha256 over (name, dtype, shape, bytes) of all tensors, the same before and after.

    Raises:
        UsageError: If `out` exists.
        CheckpointError: For parts that are missing, and for a copy that differs.
        WeightsError: For weights that cannot be read.
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
    save_file({name: value.clone().contiguous() for name, value in weights.tensors.items()}, folder / WEIGHTS_FILE)
    for name, file in side_files(parts.vlm).items():
        shutil.copyfile(file, folder / name)
    for name in _RUN_FILES:
        if (parts.run / name).is_file():
            shutil.copyfile(parts.run / name, folder / name)


def main(arguments: list[str]) -> int:
    """Convert RUN to OUT, perhaps with the vision-language model's folder, and return the exit code."""
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
