"""The location at a path or URL: a folder, or a prefix in an object store through obstore (extra `remote`).

Single objects appear complete or not at all, and `If-None-Match: *` creates them exclusively: that is all the
commit protocol needs. Folders have locks besides. In a bucket no process can know that it is alone, so nothing
that others may be writing is ever removed. There is little to remove: half an upload is no object, and objects
without a commit are written again under the same key.

A run begins with its objects created one by one, `run.json` last. Two processes that begin at once create the same
bytes, or one of them is refused.

A store may be busy or away for a while: from its first answer on, every request is repeated for `PATIENCE`. Before
it has answered once, the address is more likely wrong, and it is given up within seconds.

A store may also refuse a request because another one for the same key is under way (HTTP 409). Clients call that
"already exists" for any kind of request. Nothing is believed of it: the request is repeated, and an object counts
as there only once the store shows it.
"""

import errno
import os
import random
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal

from probe_kit._system.imports import require
from probe_kit.errors import SettingsMismatchError, StoreError, UsageError
from probe_kit.runs.array_lengths import without_length
from probe_kit.runs.folder import DRAFT, Folder, check_inside, check_size, is_inside

if TYPE_CHECKING:
    from obstore.store import ObjectStore


__all__ = [
    "SCHEMES",
    "Location",
    "locate",
]


READERS = 32
"""The small objects that are read at once, because each of them takes a round trip. A choice, not measured."""
PATIENCE = timedelta(seconds=60)
"""The time for repeating a request; the last try may then take its own time, 30 s unless AWS_TIMEOUT says so."""
FIRST_PAUSE, LONGEST_PAUSE = 0.1, 5.0
"""The seconds between two requests of the same thing, at first and at most."""
_QUICK = timedelta(seconds=5)
"""The time of `PATIENCE` with a store that never answered."""
_NO_BUCKET = "NoSuchBucket"
_BUCKET_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_ENDPOINTS = ("AWS_ENDPOINT_URL", "AWS_ENDPOINT", "AWS_ENDPOINT_URL_S3")
_ENDPOINT = re.compile(r"https?://[^\s/]+(/\S*)?", re.IGNORECASE)
_HEADERS = (
    "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_TOKEN", "AWS_REGION",
    "AWS_DEFAULT_REGION",
)  # fmt: skip
"""The variables that are part of every request, or of its signature."""
_METADATA_SERVICES = ("169.254.169.254", "169.254.170.2", "metadata.google.internal")
"""The services of cloud machines, where a client looks last for credentials."""


class Bucket:
    """A prefix of a bucket. Endpoint and credentials come from the environment, such as AWS_ACCESS_KEY_ID.

    Raises:
        MissingExtraError: Without obstore.
        UsageError: For a URL without bucket or name.
        StoreError: If the store cannot be reached or refuses.
    """

    def __init__(self, url: str) -> None:
        require("obstore", "remote")
        self._scheme, self._bucket, self._prefix = _parts_of(url)
        self._answered = False

    def __str__(self) -> str:
        return f"{self._scheme}://{self._bucket}/{self._prefix}"

    @property
    def name(self) -> str:
        """The part of the URL after the last slash."""
        return self._prefix.rpartition("/")[2]

    @property
    def path(self) -> Path:
        """A path that does not exist: reading it raises UsageError."""
        raise UsageError(f"{self} lies in an object store and has no folder; read it through `open_run`")

    @property
    def address(self) -> str:
        """The URL of the prefix."""
        return str(self)

    def path_of_export(self, name: str) -> Path:
        """Return a path in the working directory."""
        return Path(name)

    def free_bytes(self) -> None:
        """Return None: an object store has no bound."""

    # -- requests --------------------------------------------------------------------------------------

    @cached_property
    def _objects(self) -> "ObjectStore":
        from obstore.store import AzureStore, GCSStore, S3Store

        if self._scheme == "s3":
            _check_environment(str(self))
        # Not by obstore's `from_url`: it drops what follows # or ?, and reads %20 as a space.
        kinds: dict[str, Callable[..., ObjectStore]] = {"s3": S3Store, "gs": GCSStore, "az": AzureStore}
        with self.explained_errors():  # `_answer` repeats
            return kinds[self._scheme](self._bucket, prefix=self._prefix, retry_config={"max_retries": 0})

    def _answer[T](self, request: Callable[["ObjectStore"], T], key: str = "") -> T:
        """Return the answer to a request, or raise an error in our words that names the object `key`.

        All requests that break off, get no answer, or are refused for a moment are repeated, also a conditional
        put and a deletion: each of them may be done twice.
        """
        from obstore.exceptions import GenericError, JoinError

        refused = _refusals()
        passing: tuple[type[Exception], ...] = (GenericError, JoinError, *refused)
        pauses = pauses_for(lambda: PATIENCE if self._answered else _QUICK)
        with self.explained_errors(key):
            while True:
                try:
                    answer = request(self._objects)
                except FileNotFoundError:  # an answer too: the store is there, the object is not
                    self._answered = True
                    raise
                except passing as error:
                    self._answered |= isinstance(error, refused)
                    pause = next(pauses, None)
                    if pause is None:
                        raise
                else:
                    self._answered = True
                    return answer
                time.sleep(pause)

    @contextmanager
    def explained_errors(self, key: str = "") -> Iterator[None]:
        """Replace every error of obstore in the body by a StoreError that says what to do and names `key`."""
        from obstore.exceptions import BaseError

        try:
            yield
        except FileNotFoundError as error:
            if _NO_BUCKET in str(error):
                raise self._explain(error, key) from error
            raise
        except BaseError as error:
            raise self._explain(error, key) from error
        except BaseException as error:
            if type(error).__module__ != "pyo3_runtime":  # where a bug of obstore arrives, as no `Exception`
                raise
            raise self._explain(error, key) from error

    def _explain(self, error: BaseException, key: str) -> StoreError:
        """Return the error of the store, with the remedy."""
        why = str(error).split("\n\nDebug source", maxsplit=1)[0].replace("\n", " ")
        advice = (
            "Check the bucket, the network, and what the environment says of endpoint and credentials "
            "(AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID …)"
        )
        if _NO_BUCKET in str(error):
            why = f"there is no bucket {self._bucket!r}"
            advice = "Create it, or correct its name or AWS_ENDPOINT_URL"
        elif isinstance(error, _refusals()):
            why = f"it refused {key or 'a request'} for {PATIENCE.total_seconds():.0f} s, as if in use ({why})"
            advice = "See that no other program writes there"
        elif any(service in why for service in _METADATA_SERVICES):
            why = "the environment holds no credentials, and this machine has none of its own"
            advice = (
                "Set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for a public bucket"
            )
        elif key:
            why = f"of {key}: {why}"
        return StoreError(f"{self} cannot be used: {why}. {advice}; the same command continues")

    # -- objects ---------------------------------------------------------------------------------------

    def exists(self, key: str) -> bool:
        """Implement `Folder.exists` by a request for the head of the object."""
        import obstore

        if not is_inside(key):
            return False
        try:
            self._answer(lambda objects: obstore.head(objects, key), key)
        except FileNotFoundError:
            return False
        return True

    def read(self, key: str, part: slice | None = None, most: int | None = None) -> bytes:
        """Implement `Folder.read` by one request."""
        import obstore

        def content(objects: Any) -> bytes:
            if part is not None:
                return bytes(obstore.get_range(objects, key, start=part.start, end=part.stop))
            answer = obstore.get(objects, key)
            check_size(key, answer.meta["size"], self, most)
            return bytes(answer.bytes())

        if not is_inside(key):
            raise FileNotFoundError(errno.ENOENT, "no object of the run", f"{self}/{key}")
        return self._answer(content, key)

    def pieces(self, key: str) -> Iterator[bytes]:
        """Implement `Folder.pieces`: the whole object is the only piece."""
        yield self.read(key)

    def open(self, key: str) -> BinaryIO:
        """Implement `Folder.open`: all of the object is fetched at once."""
        return BytesIO(self.read(key))

    def read_all(self, folder: str, suffix: str) -> dict[str, bytes]:
        """Implement `Folder.read_all` by a listing and concurrent requests. What is gone by then is left out."""
        names = [key.removeprefix(f"{folder}/") for key in self.keys(folder)]
        names = [name for name in names if name.endswith(suffix) and "/" not in name]
        with ThreadPoolExecutor(READERS) as readers:
            contents = readers.map(lambda name: self._read_if_there(f"{folder}/{name}"), names)
            return {name: raw for name, raw in zip(names, contents, strict=True) if raw is not None}

    def _read_if_there(self, key: str) -> bytes | None:
        """Return the object, None if it was removed since it was listed: seals and failures come and go."""
        try:
            return self.read(key)
        except FileNotFoundError:
            return None

    def keys(self, folder: str) -> list[str]:
        """Implement `Folder.keys` by a listing."""
        return sorted(self._listing(folder))

    def sizes(self, folder: str, keys: Iterable[str]) -> dict[str, int]:
        """Implement `Folder.sizes` by a listing."""
        listing = self._listing(folder)
        return {key: listing[f"{folder}/{key}"] for key in keys if f"{folder}/{key}" in listing}

    def _listing(self, folder: str) -> dict[str, int]:
        import obstore

        def sizes(objects: Any) -> dict[str, int]:
            return {meta["path"]: meta["size"] for page in obstore.list(objects, folder) for meta in page}

        return self._answer(sizes, folder)

    def flush(self, keys: Iterable[str]) -> None:
        """Do nothing: a put that was answered is durable."""

    def create(self, key: str, content: bytes) -> bool:
        """Implement `Folder.create` by a put that fails where the key exists.

        A refusal alone says nothing: False means that an object of that key was then there, ours or another's.
        """
        return self._put(key, content, "create")

    def write(self, key: str, content: bytes, durable: bool = True) -> None:  # noqa: ARG002 - always
        """Implement `Folder.write` by a put, which is durable in any case."""
        self._put(key, content, "overwrite")

    def _put(self, key: str, content: bytes, mode: Literal["create", "overwrite"]) -> bool:
        import obstore
        from obstore.exceptions import AlreadyExistsError, BaseError, GenericError

        def put(objects: Any) -> bool:
            try:
                obstore.put(objects, key, content, mode=mode)
            except AlreadyExistsError:
                if mode == "overwrite" or not _is_there(objects, key):
                    raise  # a conflict of the moment: to be repeated
                return False
            except FileNotFoundError as error:
                # No object can be missing here, only the bucket, or an upload in parts that is over: the reply to
                # its completion was lost.
                raise (BaseError if _NO_BUCKET in str(error) else GenericError)(str(error)) from error
            return True

        check_inside(key, self)
        return self._answer(put, key)

    def delete(self, key: str) -> None:
        """Implement `Folder.delete` by one request."""
        self._delete([key])

    def remove(self, folder: str) -> None:
        """Implement `Folder.remove` by a listing, then bulk deletions."""
        self._delete(self.keys(folder))

    def _delete(self, keys: list[str]) -> None:
        import obstore

        def delete(objects: Any) -> None:
            try:
                obstore.delete(objects, keys)
            except FileNotFoundError as error:  # some stores say so of what was removed before, and stop there
                if _NO_BUCKET in str(error):
                    raise
                for key in keys:
                    with suppress(FileNotFoundError):
                        obstore.delete(objects, key)

        for key in keys:
            check_inside(key, self)
        if keys:
            self._answer(delete, keys[0])

    # -- runs ------------------------------------------------------------------------------------------

    @contextmanager
    def locked(self, clear: Callable[[], None]) -> Iterator[None]:
        """Call `clear` and run the body: an object store has no locks."""
        clear()
        yield

    @contextmanager
    def take_turns(self, folder: str) -> Iterator[None]:  # noqa: ARG002 - an object store holds no drafts
        """Run the body without a lock: files of other content have other names, and the last head counts."""
        yield


def _is_there(objects: "ObjectStore", key: str) -> bool:
    import obstore

    try:
        obstore.head(objects, key)
    except FileNotFoundError:
        return False
    return True


def _refusals() -> tuple[type[Exception], ...]:
    """Return the errors by which obstore says that a store did not carry a request out for now (409, 412, 304)."""
    from obstore.exceptions import AlreadyExistsError, NotModifiedError, PreconditionError

    return AlreadyExistsError, NotModifiedError, PreconditionError


def _check_environment(where: str) -> None:
    """Raise StoreError for variables that obstore cannot take; it then stops with many lines about itself."""
    for name in _HEADERS:
        if not os.environ.get(name, "").isprintable():
            raise StoreError(
                f"{where} cannot be used: the environment variable {name} holds a line break or another control "
                "character. Set it again without"
            )
    for name in _ENDPOINTS:
        if not _ENDPOINT.fullmatch(os.environ.get(name, "http://host")):
            raise StoreError(
                f"{where} cannot be used: the environment variable {name} is {os.environ[name]!r}; expected "
                "https://HOST or http://HOST:PORT. Correct it, or unset it to use Amazon's"
            )


def pauses_for(time_to_repeat: Callable[[], timedelta]) -> Iterator[float]:
    """Yield the seconds to wait before every further try, until the time is over, which may become longer.

    Pauses double up to `LONGEST_PAUSE`. Each is drawn between a half and all of that, so that two writers which
    met do not meet again.
    """
    pause, start = FIRST_PAUSE, time.monotonic()
    while time.monotonic() + pause <= start + time_to_repeat().total_seconds():
        yield random.uniform(pause / 2, pause)
        pause = min(2 * pause, LONGEST_PAUSE)


# -- the location of an address ----------------------------------------------------------------------------------


SCHEMES = ("s3", "gs", "az")


def _parts_of(url: str) -> tuple[str, str, str]:
    """Return scheme, bucket and prefix of a URL, character for character; only a slash at the end is left out.

    Raises:
        UsageError: For a URL that names no place exactly.
    """
    scheme, _, address = url.partition("://")
    bucket, _, prefix = address.partition("/")
    prefix = prefix.removesuffix("/")
    expected = f"expected {scheme}://BUCKET/PREFIX/RUN"
    if not (bucket and prefix):
        raise UsageError(f"{url} names no run; {expected}")
    if not _BUCKET_NAME.fullmatch(bucket):
        raise UsageError(
            f"{url}: {bucket!r} is no name of a bucket, which has letters, digits, dots, hyphens and underscores; "
            f"{expected}"
        )
    if strange := [part for part in prefix.split("/") if not is_inside(part)]:
        problem = f"has the part {strange[0]!r}" if strange[0] else "has two slashes in a row"
        raise UsageError(f"{url} {problem} behind its bucket, which stores read in different ways; {expected}")
    return scheme, bucket, prefix


Location = Folder | Bucket
"""The place of a run; `Folder` has the contract of its methods."""


def check_exclusive(location: Location, key: str, content: bytes | None = None) -> None:
    """Raise StoreError unless a second `create` of the object `key` is refused, on which commits rely.

    Args:
        location: The place that holds the object.
        key: The key of the object.
        content: The content of the object, where it is known; else it is read.
    """
    if location.create(key, location.read(key) if content is None else content):
        raise StoreError(
            f"{location}: the store created {key} a second time: it ignores conditional puts (If-None-Match), and "
            "cannot keep two writers apart. Use another store, or a folder"
        )


def begin(location: Location, objects: Mapping[str, bytes], last: str) -> None:
    """Begin with these objects, created one after another; `last`, one of them, never appears without all others.

    A killed beginning is continued by the next one. If another process is first, its objects stay.

    Raises:
        SettingsMismatchError: If something else is there.
        StoreError: If the store ignores conditional puts.
    """
    present = {key for key in location.keys("") if not key.endswith(DRAFT)}
    if (strange := sorted(present - set(objects))) and last not in present:
        raise SettingsMismatchError(f"{location} holds {strange[0]} and is not a run; choose another --out")
    for key, content in objects.items():
        try:
            # A process that began at the same time, and was quicker, may have said how long the arrays are.
            same = key == last or location.create(key, content) or without_length(location.read(key)) == content
        except NotADirectoryError as error:
            raise SettingsMismatchError(f"{location} is a file, not a folder; choose another --out") from error
        if not same:
            raise SettingsMismatchError(
                f"{location} holds the beginning of a run with another {key}: one of other settings, killed early "
                "or beginning now in another process. Choose another --out, or remove it"
            )
    # Tried on a real key, before the run exists: a store that cannot keep writers apart is refused at once.
    check_exclusive(location, *next((key, content) for key, content in objects.items() if key != last))
    location.create(last, objects[last])


def locate(where: str | Path | Location) -> Location:
    """Return the location at a folder or a URL such as `s3://bucket/prefix/run`.

    Raises:
        MissingExtraError: For a URL without the extra `remote`.
        UsageError: For a URL of another kind.
    """
    if isinstance(where, Location):
        return where
    scheme, separator, _ = str(where).partition("://")
    if isinstance(where, Path) and where.parts and where.parts[0].rstrip(":") in SCHEMES and ":" in where.parts[0]:
        raise UsageError(f"{where} was a URL before it became a Path; give it as text")
    if not separator:
        return Folder(Path(where))
    if scheme not in SCHEMES:
        raise UsageError(f"{where}: runs lie in folders or at {', '.join(f'{s}://' for s in SCHEMES)}")
    return Bucket(str(where))
