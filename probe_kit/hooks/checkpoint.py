"""Finding the files of a checkpoint: a local folder, or a hub id that is downloaded first."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from probe_kit.errors import CheckpointError

# What decides how a model is built and spoken to, and the beginnings of names that hold weights or list them.
_READ = (".json", ".safetensors", ".model", ".txt", ".jinja", ".yaml", ".yml")
_WEIGHTS = ("model.safetensors", "model-", "adapter_model", "pytorch_model")
PATTERNS = ("*.json", "*.safetensors", "*.model", "*.txt", "*.jinja")


def checkpoint_folder(checkpoint: str, patterns: Sequence[str] = PATTERNS) -> Path:
    """The local folder of a folder path or hub id such as `lerobot/pi0_base`.

    patterns: which files of a hub repository are needed.
    Raises CheckpointError if the folder is not there or the hub cannot deliver it.
    """
    folder = Path(checkpoint).expanduser()
    if folder.is_dir():
        return folder
    if checkpoint.count("/") != 1 or checkpoint.startswith((".", "/", "~")):
        raise CheckpointError(f"checkpoint folder {checkpoint!r} does not exist")
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError, RepositoryNotFoundError

    try:
        return Path(snapshot_download(checkpoint, allow_patterns=list(patterns)))
    except (RepositoryNotFoundError, LocalEntryNotFoundError, HfHubHTTPError, OSError) as error:
        reason = str(error).strip().splitlines()[0]
        raise CheckpointError(
            f"cannot fetch {checkpoint!r} from the hub ({reason}). Check the name, your network and, for gated "
            "models, `hf auth login`; or pass a local folder as --checkpoint"
        ) from error


def side_files(folder: Path, prefix: str = "") -> dict[str, Path]:
    """The files of `folder` besides weights and documents, by name: all that a loader may read there.

    prefix: put before every name, to tell folders apart.
    """
    return {
        f"{prefix}{path.name}": path
        for path in sorted(folder.iterdir())
        if path.suffix in _READ and path.is_file() and not path.name.startswith(_WEIGHTS)
    }


def content_hashes(files: Mapping[str, Path]) -> dict[str, str]:
    """`file <name>` → sha256 of its bytes, for `Card.settings`: where a checkpoint lies does not matter."""
    return {f"file {name}": hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()}
