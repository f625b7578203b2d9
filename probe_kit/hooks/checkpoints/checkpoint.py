"""The files of a checkpoint, in a local folder or downloaded from the hub. Imports no torch."""

import hashlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from threading import Thread
from types import MappingProxyType
from typing import Any, NamedTuple
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from probe_kit._system.bounded_files import (
    MOST_BYTES,
    check_regular,
    load_json,
    load_yaml,
    open_regular,
    read_regular_text,
)
from probe_kit.errors import CheckpointError, UsageError, WeightsError
from probe_kit.models.bounds import check_sizes

PATIENCE = 5.0
"""Seconds without a reply after which the hub counts as unreachable."""
OFFLINE_WAY_OUT = "Connect to the network once, or fill the cache with `hf download`"
"""The advice where the hub cannot be asked."""
_WITHOUT_NETWORK = ContextVar("without_network", default=False)


@contextmanager
def without_network() -> Iterator[None]:
    """A context in which only the cache of the hub is read, as for a plan."""
    token = _WITHOUT_NETWORK.set(True)
    try:
        yield
    finally:
        _WITHOUT_NETWORK.reset(token)


def unreachable() -> str:
    """Return why the hub cannot be asked now; empty if it answers, whatever it says.

    A proxy that the environment names is used. Nothing is sent when the hub's own offline mode is on.
    """
    if _WITHOUT_NETWORK.get():
        return "a plan asks no network"
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        return "offline mode (HF_HUB_OFFLINE)"
    replies: list[str] = []
    asking = Thread(target=lambda: replies.append(_ask(constants.ENDPOINT)), daemon=True)
    asking.start()
    asking.join(PATIENCE)  # looking a name up knows no time limit of its own
    return replies[0] if replies else _silence(constants.ENDPOINT)


def _ask(address: str) -> str:
    try:
        urlopen(Request(address, method="HEAD"), timeout=PATIENCE).close()
    except HTTPError:
        return ""  # it answered
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        return _silence(address) if isinstance(reason, TimeoutError) else f"{address} does not answer: {reason}"
    return ""


def _silence(address: str) -> str:
    return f"{address} did not answer within {PATIENCE:g} s"


def hub_reason(error: Exception) -> str:
    """Return why the hub delivers nothing, in words: its client reports several reasons by one exception."""
    from huggingface_hub import errors, get_token

    cause = _cause(error)
    status = _status(cause)
    message = str(getattr(cause, "server_message", None) or error)  # the hub's own words, where it answered
    first = (message.strip().splitlines() or [type(error).__name__])[0]
    if isinstance(cause, errors.GatedRepoError):
        return "its authors give access on request (gated), and yours is not granted"
    if isinstance(cause, errors.DisabledRepoError):
        return "the hub has disabled it"
    if isinstance(cause, errors.RevisionNotFoundError):
        return f"it has no such revision: {first}"
    if status == 401 and get_token():
        return "the hub refuses your token (401): it is expired, revoked or mistyped"
    if isinstance(cause, errors.RepositoryNotFoundError):
        hidden = "your token does not open it" if get_token() else "no token is set"
        return f"there is no such repository, or it is private and {hidden}"
    if isinstance(cause, errors.EntryNotFoundError) and not isinstance(cause, errors.LocalEntryNotFoundError):
        return f"the repository lacks a file: {first}"
    return f"the hub answers {status}: {first}" if status else first


def way_out(error: Exception) -> str:
    """Return advice on a refusal of the hub."""
    from huggingface_hub import errors, get_token

    cause = _cause(error)
    if isinstance(cause, errors.GatedRepoError):
        return "Ask for access on the model's page" if get_token() else "Run `hf auth login`"
    if isinstance(cause, errors.RevisionNotFoundError):
        return "Look the branches, tags and commits up on its page"
    if _status(cause) == 401 and get_token():
        return "Run `hf auth login` with a new token, or `hf auth logout` for a public model"
    if isinstance(cause, errors.RepositoryNotFoundError):
        return "Check the name, and run `hf auth login` for a private model"
    return "Check the name, your network and, for gated models, `hf auth login`"


def _cause(error: BaseException) -> BaseException:
    """The refusal behind an error of the cache: the client looks there when the hub refuses."""
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError

    cause = error.__cause__
    return cause if isinstance(error, LocalEntryNotFoundError) and isinstance(cause, HfHubHTTPError) else error


def _status(error: BaseException) -> int | None:
    """The status of an answer; None for an error without one."""
    status: int | None = getattr(getattr(error, "response", None), "status_code", None)
    return status


# -- commits ---------------------------------------------------------------------------------------------

_PINNED: ContextVar[Mapping[str, str]] = ContextVar("pinned", default=MappingProxyType({}))
_RECORDED: ContextVar[dict[str, str] | None] = ContextVar("recorded", default=None)


@contextmanager
def pinned_commits(commits: Mapping[str, str]) -> Iterator[None]:
    """A context in which repositories are read at these commits, by name, unless a revision is asked for."""
    token = _PINNED.set({**_PINNED.get(), **commits})
    try:
        yield
    finally:
        _PINNED.reset(token)


@contextmanager
def recorded_commits() -> Iterator[dict[str, str]]:
    """A context whose value gets the commit of every repository of the hub that is read inside, by name."""
    commits: dict[str, str] = {}
    token = _RECORDED.set(commits)
    try:
        yield commits
    finally:
        _RECORDED.reset(token)


def pinned_commit(repository: str) -> str:
    """Return the commit at which a repository is to be read; empty where any is fine."""
    return _PINNED.get().get(repository, "")


def record_commit(repository: str, commit: str) -> None:
    """Note that files of a commit were read."""
    if (commits := _RECORDED.get()) is not None:
        commits[repository] = commit


# -- files ----------------------------------------------------------------------------------------------------

CONFIG_FILE, ADAPTER_FILE = "config.json", "adapter_config.json"
GENERATION_FILE = "generation_config.json"
WEIGHTS_FILE, INDEX_FILE = "model.safetensors", "model.safetensors.index.json"

# What decides how a model is built and spoken to, and the beginnings of names that hold weights or list them.
_READ = (".json", ".safetensors", ".model", ".txt", ".jinja", ".yaml", ".yml")
_MOST_WEIGHT_BYTES = 1 << 44
_WEIGHTS = ("model.safetensors", "model-", "adapter_model", "pytorch_model")
_CONFIGURATIONS = ("*config*.json", "dims.json", "*.yaml", "*.yml")
PATTERNS = ("*.json", "*.safetensors", "*.model", "*.txt", "*.jinja")
SMALL_FILES = ("*.json", "*.model", "*.txt", "*.jinja", "adapter_model.safetensors")
"""The patterns of files that hold no weights, but for an adapter's."""
COMMIT_DIGITS = 40
"""The number of digits of a commit's full name."""
RUN_WEIGHTS = "checkpoints/latest-checkpoint.pt"
"""The file in which a folder of a training run of Prismatic keeps its weights."""


class NotCachedError(LookupError):
    """The cause of a CheckpointError about a repository that the cache lacks where the hub cannot be asked."""


class HubName(NamedTuple):
    """A checkpoint on the hub.

    Attributes:
        folder: Folder inside the repository; empty for none.
        revision: Branch, tag or commit; empty for none.
    """

    repository: str
    folder: str = ""
    revision: str = ""


def hub_name(checkpoint: str) -> HubName | None:
    """Return the parts of `owner/repo`, `owner/repo/folder` and either with `@revision`; None for other text."""
    name, at, revision = checkpoint.partition("@")
    parts = name.split("/")
    if (
        len(parts) not in (2, 3)
        or name.startswith((".", "/", "~"))
        or not all(parts)
        or bool(at) != bool(revision)
    ):
        return None
    return HubName("/".join(parts[:2]), "/".join(parts[2:]), revision)


def without_revision(checkpoint: str | None) -> str | None:
    """Return a hub id without its revision; anything else as it is."""
    if checkpoint is None or not is_on_hub(checkpoint):
        return checkpoint
    return checkpoint.partition("@")[0]


def pin_revision(checkpoint: str) -> str:
    """Return a hub id with the commit that the cache has of its revision; anything else as it is.

    Asks no network.
    """
    parts = hub_name(checkpoint) if is_on_hub(checkpoint) else None
    snapshot = None if parts is None else _snapshot(parts)
    return checkpoint if snapshot is None else f"{without_revision(checkpoint)}@{snapshot.name}"


def cached_folder(checkpoint: str) -> Path | None:
    """The folder of a hub id in the hub's cache; None where it has nothing of it.

    Asks no network.
    """
    parts = hub_name(checkpoint) if is_on_hub(checkpoint) else None
    snapshot = None if parts is None else _snapshot(parts)
    if parts is None or snapshot is None:
        return None
    folder = snapshot / parts.folder
    return folder if folder.is_dir() else None


def _snapshot(parts: HubName) -> Path | None:
    """The cache's folder of a revision's commit, by which it is called; None where it has none."""
    cache, commit = _cache_of(parts.repository), parts.revision or "main"
    snapshots = cache / "snapshots"
    if len(commit) != COMMIT_DIGITS or not (snapshots / commit).is_dir():
        ref = cache / "refs" / commit
        commit = read_regular_text(ref).strip() if ref.is_file() else ""
    return snapshots / commit if commit and (snapshots / commit).is_dir() else None


def is_in_cache(folder: Path) -> bool:
    """Whether a folder lies in the cache of the hub."""
    return _cache() in folder.parents


def _cache_of(repository: str) -> Path:
    # Not the hub's own function: it refuses names that no repository can have, and nothing is looked up here.
    return _cache() / f"models--{repository.replace('/', '--')}"


def _cache() -> Path:
    from huggingface_hub import constants

    return Path(constants.HF_HUB_CACHE)


def is_on_hub(checkpoint: str) -> bool:
    """Whether a checkpoint is named by a hub id, and not by a folder or file that is here."""
    return hub_name(checkpoint) is not None and not Path(checkpoint).expanduser().exists()


def plain_folder(checkpoint: str, patterns: Sequence[str] = PATTERNS) -> Path:
    """The local folder of a folder path or hub id.

    A hub id is a name such as `lerobot/pi0_base`, or `owner/repo/folder` for one model of a repository that holds
    several. `@revision` behind it names a branch, a tag or a commit.

    Args:
        checkpoint: Folder path or hub id.
        patterns: The files of a hub repository, or of its folder, that are needed; no others are downloaded.

    Raises:
        CheckpointError: If the folder is not there or the hub cannot deliver it.
    """
    try:
        folder = Path(checkpoint).expanduser()
    except RuntimeError as error:  # ~name of an unknown user
        raise CheckpointError(f"checkpoint folder {checkpoint!r} does not exist ({error})") from None
    if not folder.is_dir():
        folder = _fetch_folder(checkpoint, patterns)
    return _possible(folder)


def _fetch_folder(checkpoint: str, patterns: Sequence[str]) -> Path:
    """The folder of a hub id, of which the cache has a copy then.

    Raises:
        CheckpointError: If the hub cannot deliver it and the cache has no copy.
    """
    parts = hub_name(checkpoint)
    if parts is None:
        raise CheckpointError(f"{_not_here(checkpoint)}. Give the folder of a checkpoint, or a hub id OWNER/NAME")
    parts = _with_pin(parts)
    why = unreachable()
    snapshot = _snapshot(parts) if why else _download_commit(checkpoint, parts, patterns)
    if snapshot is None:
        raise CheckpointError(
            _not_fetched(checkpoint, f"{why}; the cache has no copy", OFFLINE_WAY_OUT)
        ) from NotCachedError(parts.repository)
    record_commit(parts.repository, snapshot.name)
    folder = snapshot / parts.folder
    if not folder.is_dir():
        raise CheckpointError(
            f"the repository {parts.repository} has no folder {parts.folder!r}; look its folders up on its page"
        )
    return folder


def _with_pin(parts: HubName) -> HubName:
    """A name at the commit that a repetition reads, unless it has a revision."""
    return parts if parts.revision else parts._replace(revision=pinned_commit(parts.repository))


def _download_commit(checkpoint: str, parts: HubName, patterns: Sequence[str]) -> Path:
    """The folder of a commit, with the files of these patterns.

    Raises:
        CheckpointError: If the hub cannot deliver it.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError, RepositoryNotFoundError

    paths = [f"{parts.folder}/{pattern}" if parts.folder else pattern for pattern in patterns]
    try:
        return Path(snapshot_download(parts.repository, revision=parts.revision or None, allow_patterns=paths))
    except (RepositoryNotFoundError, LocalEntryNotFoundError, HfHubHTTPError, OSError, ValueError) as error:
        raise CheckpointError(_not_fetched(checkpoint, hub_reason(error), way_out(error))) from error


def _not_fetched(checkpoint: str, reason: str, advice: str) -> str:
    """The message about a hub id of which nothing arrives."""
    return (
        f"{_not_here(checkpoint)}, and as a hub id it cannot be fetched ({reason}). {advice}; or pass a local "
        "folder as --checkpoint"
    )


def _not_here(checkpoint: str) -> str:
    """The part of a message that says where a folder was looked for."""
    where = "" if Path(checkpoint).is_absolute() or checkpoint.startswith("~") else f" in {Path.cwd()}"
    return f"checkpoint folder {checkpoint!r} does not exist{where}"


def hub_files(checkpoint: str) -> list[str]:
    """Return paths of the files of a hub id, sorted: as the hub lists them, or as the cache has them offline.

    Of `owner/repo/folder`, below that folder. Nothing is downloaded.

    Raises:
        CheckpointError: For a text that is no hub id, and for a repository that neither has.
    """
    parts = hub_name(checkpoint)
    if parts is None:
        raise CheckpointError(f"{checkpoint!r} is no hub id; expected owner/repo or owner/repo/folder")
    repository, inside, revision = _with_pin(parts)
    begin = f"{inside}/" if inside else ""
    if unreachable():
        folder = plain_folder(checkpoint, ())
        paths = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
        return sorted(paths)
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HfHubHTTPError

    try:
        listed = HfApi().list_repo_files(repository, revision=revision or None)
    except (HfHubHTTPError, OSError, ValueError) as error:
        raise CheckpointError(
            f"cannot list the files of {checkpoint!r} on the hub ({hub_reason(error)}). {way_out(error)}"
        ) from error
    return sorted(name.removeprefix(begin) for name in listed if name.startswith(begin))


def _possible(folder: Path) -> Path:
    """Return the folder, if its files can be read and no configuration asks for a network beyond all sizes.

    A configuration that cannot be read as JSON or YAML is left to its loader, which names it.

    Raises:
        CheckpointError: For a network beyond all sizes, and for a file beside the weights that is a pipe, a device
            or huge. Libraries read such files without a bound.
    """
    for file in sorted(path for pattern in ("*", "*/*") for path in folder.glob(pattern)):
        if file.suffix in _READ and not file.is_dir() and file.exists():
            weights = file.suffix == ".safetensors" or file.name.startswith(_WEIGHTS)
            try:
                check_regular(file, _MOST_WEIGHT_BYTES if weights else MOST_BYTES)
            except OSError as error:
                raise CheckpointError(
                    f"{file} cannot be read: {error.strerror}. Take the original checkpoint"
                ) from error
    for file in sorted(path for pattern in _CONFIGURATIONS for path in folder.glob(pattern)):
        try:
            check_sizes(_content(file), str(file))
        except (OSError, ValueError):
            continue
    return folder


def _content(file: Path) -> Any:
    """The content of a JSON or YAML file.

    Raises:
        ValueError: For a file that is neither.
    """
    if file.suffix == ".json":
        return load_json(file)
    return load_yaml(file)


def chosen_dtype(requested: str | None, stored: object, offered: Collection[str]) -> str:
    """Return the dtype that was asked for, or else what a checkpoint's configuration says; float32 without either.

    Args:
        requested: The dtype that was asked for; None for none.
        stored: The entry of the configuration; None or "" where it has none.
        offered: The dtypes that the family can run in.

    Raises:
        UsageError: For a requested dtype that is not offered.
        CheckpointError: For a stored dtype that is not offered.
    """
    if requested is not None:
        if requested not in offered:
            raise UsageError(f"dtype {requested!r} is not one of {', '.join(offered)}")
        return requested
    name = str(stored or "float32").removeprefix("torch.")
    if name not in offered:
        raise CheckpointError(
            f"its configuration says dtype {name!r}; expected one of {', '.join(offered)}. Pass one as --dtype"
        )
    return name


def side_files(folder: Path, prefix: str = "") -> dict[str, Path]:
    """Return the files of `folder` besides weights and documents, by name: all that a loader may read there.

    `prefix` is put before every name, to tell folders apart.
    """
    return {
        f"{prefix}{path.name}": path
        for path in sorted(folder.iterdir())
        if path.suffix in _READ and path.is_file() and not path.name.startswith(_WEIGHTS)
    }


def is_weights(path: Path) -> bool:
    """Whether a file holds weights of a network, or lists the files that do."""
    return path.name.startswith(_WEIGHTS) or path.suffix in (".pt", ".pth", ".bin")


def content_hashes(files: Mapping[str, Path]) -> dict[str, str]:
    """Return `file <name>` → sha256 of its bytes, for `ModelCard.settings`: a checkpoint's place has no effect."""
    return {f"file {name}": _content_hash(path) for name, path in files.items()}


def _content_hash(path: Path) -> str:
    with open_regular(path, pointers=True) as file:  # a loader may read none of a folder's files that are pointers
        return hashlib.file_digest(file, "sha256").hexdigest()


def shard_name(name: object) -> str:
    """Return a file's name as an index gives it.

    Raises:
        ValueError: For a path: shards lie beside their index.
    """
    if not isinstance(name, str) or name in ("", ".", "..") or Path(name).name != name or "\\" in name:
        raise ValueError(f"{name!r} is no name of a file beside it")
    return name


def listed_shards(index: Path) -> list[str]:
    """Return the names of the files that an index of shards lists, sorted.

    Raises:
        ValueError: For a file that is no index of shards.
    """
    try:
        return sorted({shard_name(name) for name in load_json(index)["weight_map"].values()})
    except (OSError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(error) from error


def check_unambiguous(folder: Path) -> None:
    """Raise WeightsError for a folder with two sets of weights: one file, and an index that lists other files.

    Some loaders take the one, some the other; nothing says which of them is meant.
    """
    single, index = folder / WEIGHTS_FILE, folder / INDEX_FILE
    if not (single.is_file() and index.is_file()):
        return
    try:
        shards = [name for name in listed_shards(index) if name != WEIGHTS_FILE]
    except ValueError as error:
        raise WeightsError(
            f"{index} is damaged ({error}), beside {WEIGHTS_FILE}. Remove the one that is not meant"
        ) from error
    if shards:
        more = f" and {len(shards) - 1} more" if len(shards) > 1 else ""
        raise WeightsError(
            f"{folder} holds two sets of weights: {WEIGHTS_FILE}, and {INDEX_FILE} with {shards[0]}{more}. "
            "Nothing says which one is meant: remove the other one"
        )


def missing_bytes(folder: Path) -> int | None:
    """Return the bytes of weights that an index of shards lists and the folder lacks; None where no index says it.

    An index has the size of all tensors, `total_size`.
    """
    try:
        index = load_json(folder / INDEX_FILE)
        total = index["metadata"]["total_size"]
        shards = listed_shards(folder / INDEX_FILE)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if type(total) is not int or total < 1:
        return None
    return max(0, total - sum((folder / name).stat().st_size for name in shards if (folder / name).is_file()))


def missing_weights(folder: Path) -> str:
    """Return the names of weights that a folder lacks, as a sentence; empty if all files are there."""
    index = folder / INDEX_FILE
    if (folder / WEIGHTS_FILE).is_file() or (folder / RUN_WEIGHTS).is_file():
        return ""
    if index.is_file():
        try:
            shards = listed_shards(index)
        except ValueError as error:
            return f"{INDEX_FILE} is damaged ({error})"
        absent = [name for name in shards if not (folder / name).is_file()]
        return f"{', '.join(absent)} of {INDEX_FILE} are missing" if absent else ""
    return (
        ""
        if len(list(folder.glob("*.pt"))) == 1
        else f"neither {WEIGHTS_FILE} nor {INDEX_FILE} nor one .pt file is there"
    )
