"""Finding the files of a checkpoint: a local folder, or a hub id that is downloaded first."""

from pathlib import Path

from probe_kit.errors import CheckpointError

_PATTERNS = ["*.json", "*.safetensors", "*.model", "*.txt", "*.jinja"]


def checkpoint_folder(checkpoint: str) -> Path:
    """The local folder of a folder path or hub id such as `lerobot/pi0_base`.

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
        return Path(snapshot_download(checkpoint, allow_patterns=_PATTERNS))
    except (RepositoryNotFoundError, LocalEntryNotFoundError, HfHubHTTPError, OSError) as error:
        reason = str(error).strip().splitlines()[0]
        raise CheckpointError(
            f"cannot fetch {checkpoint!r} from the hub ({reason}). Check the name, your network and, for gated "
            "models, `hf auth login`; or pass a local folder as --checkpoint"
        ) from error
