"""A prefix in an object store as the location of a run (extra `remote`).

Single objects appear whole or not at all, and `If-None-Match: *` creates them exclusively: that is all the commit
protocol needs. What folders have besides, locks and renaming, is missing, and replaced as follows.

* No process can know that it is alone, so nothing that others may be writing is ever removed. There is little to
  remove: half an upload is no object, and objects without a commit are written again under the same key.
* A run begins with its objects created one by one, `run.json` last. Two processes that begin at once create the
  same bytes, or one of them is refused.
* Derived groups carry their stamp in their key, so that processes that saw different commits never mix them.

A store may be busy or away for a while: from its first answer on, every request is repeated for `PATIENCE`. Before
it has answered once, what is wrong is rather the address, and it is given up within seconds.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import timedelta
from functools import cached_property
from io import SEEK_SET, BufferedReader, RawIOBase
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal
from urllib.parse import urlsplit

from zarr.abc.store import Store

from probe_kit._system.optional_dependencies import require
from probe_kit.errors import SettingsMismatchError, StoreError, UsageError
from probe_kit.runs.location import Location, check_size
from probe_kit.runs.object_stores import LONGEST_PAUSE, BlankStore, PatientStore, pauses_between

if TYPE_CHECKING:
    from obstore import ReadableFile
    from obstore.store import ObjectStore

# Small objects are read side by side, because each of them takes a round trip.
READERS = 32
PATIENCE = timedelta(seconds=60)
"""So long requests are repeated; the last of them may then take its own time, 30 s unless AWS_TIMEOUT says so."""
_QUICK = timedelta(seconds=5)
"""For a store that never answered."""
STAMP_DIGITS = 16
_NO_BUCKET = "NoSuchBucket"
# Where a client looks last for credentials: the metadata services of cloud machines.
_ASKED_FOR_CREDENTIALS = ("169.254.169.254", "169.254.170.2", "metadata.google.internal")


class Bucket(Location):
    """A prefix of a bucket. Endpoint and credentials come from the environment, such as AWS_ACCESS_KEY_ID.

    Raises MissingExtraError without obstore, UsageError for a URL without bucket or name, StoreError if the store
    cannot be reached or refuses.
    """

    def __init__(self, url: str) -> None:
        require("obstore", "remote")
        self._url = url.rstrip("/")
        self._answered = False
        parts = urlsplit(self._url)
        if not (parts.netloc and parts.path.strip("/")):
            raise UsageError(f"{url} names no run; expected {parts.scheme}://BUCKET/PREFIX/RUN")

    def __str__(self) -> str:
        return self._url

    @property
    def name(self) -> str:
        """After the last slash."""
        return self._url.rpartition("/")[2]

    @property
    def path(self) -> Path:
        """Raises UsageError."""
        raise UsageError(f"{self} lies in an object store and has no folder; read it through `open_run`")

    @property
    def address(self) -> str:
        """The URL."""
        return self._url

    def beside(self, name: str) -> Path:
        """In the working directory."""
        return Path(name)

    def free_bytes(self) -> None:
        """No bound."""
        return

    @property
    def _objects(self) -> "ObjectStore":
        return self._patient if self._answered else self._quick

    @cached_property
    def _patient(self) -> "ObjectStore":
        return self._below("")

    @cached_property
    def _quick(self) -> "ObjectStore":
        return self._below("", quick=True)

    def _below(self, folder: str, quick: bool = False) -> "ObjectStore":
        from obstore.store import from_url

        with self.in_words():
            store: ObjectStore = from_url(
                f"{self._url}/{folder}".rstrip("/"),
                retry_config={
                    "retry_timeout": _QUICK if quick else PATIENCE,
                    "max_retries": 10 if quick else 10_000,
                    "backoff": {"max_backoff": timedelta(seconds=LONGEST_PAUSE)},
                },
            )
        return store

    def _asked[T](self, ask: Callable[["ObjectStore"], T]) -> T:
        """What the store answers.

        obstore repeats requests that change nothing, and is repeated here: a listing that breaks off, a
        conditional put or a deletion without an answer. All of them may be done twice.
        """
        from obstore.exceptions import AlreadyExistsError, GenericError

        pauses, end = pauses_between(), time.monotonic() + PATIENCE.total_seconds()
        while True:
            try:
                answer = ask(self._objects)
            except (FileNotFoundError, AlreadyExistsError):
                self._answered = True
                raise
            except GenericError:
                pause = next(pauses)
                if not self._answered or time.monotonic() + pause > end:
                    raise
            else:
                self._answered = True
                return answer
            time.sleep(pause)

    @contextmanager
    def in_words(self) -> Iterator[None]:
        """Whatever obstore says."""
        from obstore.exceptions import BaseError

        try:
            yield
        except FileNotFoundError as error:
            if _NO_BUCKET in str(error):
                raise self._refused(error) from error
            raise
        except BaseError as error:
            raise self._refused(error) from error

    def _refused(self, error: Exception) -> StoreError:
        """What the store said, and what is to be done about it."""
        why = str(error).split("\n\nDebug source", maxsplit=1)[0]
        advice = (
            "Check the bucket, the network, and what the environment says of endpoint and credentials "
            "(AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID …)"
        )
        if _NO_BUCKET in str(error):
            bucket = urlsplit(self._url).netloc
            why, advice = f"there is no bucket {bucket!r}", "Create it, or correct its name or AWS_ENDPOINT_URL"
        elif any(place in why for place in _ASKED_FOR_CREDENTIALS):
            why = "the environment holds no credentials, and this machine has none of its own"
            advice = (
                "Set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for a public bucket"
            )
        return StoreError(f"{self} cannot be used: {why}. {advice}; the same command continues")

    def exists(self, key: str) -> bool:
        """One request for the head of the object."""
        import obstore

        try:
            with self.in_words():
                self._asked(lambda objects: obstore.head(objects, key))
        except FileNotFoundError:
            return False
        return True

    def read(self, key: str) -> bytes:
        """One request."""
        import obstore

        def whole(objects: Any) -> bytes:
            answer = obstore.get(objects, key)
            check_size(key, answer.meta["size"], self)
            return bytes(answer.bytes())

        with self.in_words():
            return self._asked(whole)

    def open(self, key: str) -> BinaryIO:
        """Reads ranges when they are asked for."""
        import obstore

        with self.in_words():
            return BufferedReader(_Ranges(self._asked(lambda objects: obstore.open_reader(objects, key)), self))

    def read_all(self, folder: str, suffix: str) -> dict[str, bytes]:
        """A listing, then many requests side by side. What was listed and is gone by then is left out."""
        names = [key.removeprefix(f"{folder}/") for key in self.keys(folder)]
        names = [name for name in names if name.endswith(suffix) and "/" not in name]
        with ThreadPoolExecutor(READERS) as readers:
            contents = readers.map(lambda name: self._read_if_there(f"{folder}/{name}"), names)
            return {name: raw for name, raw in zip(names, contents, strict=True) if raw is not None}

    def _read_if_there(self, key: str) -> bytes | None:
        """None for what was removed since it was listed: seals and failures come and go."""
        try:
            return self.read(key)
        except FileNotFoundError:
            return None

    def keys(self, folder: str) -> list[str]:
        """From a listing."""
        return sorted(self._listing(folder))

    def sizes(self, folder: str, keys: Iterable[str]) -> dict[str, int]:
        """From a listing."""
        there, wanted = self._listing(folder), {key: f"{folder}/{key}" for key in keys}
        return {key: there[full] for key, full in wanted.items() if full in there}

    def confirm(self, lengths: Mapping[str, int]) -> None:
        """A request for the head of each, side by side."""
        there = self._lengths(lengths)
        for key, length in lengths.items():
            if (found := there.get(key, 0)) != length:
                raise StoreError(
                    f"{self} confirmed {length:,} bytes of {key} and holds {found:,}. No commit depends on "
                    "it. Check the store, then run the same command to resume"
                )

    def _lengths(self, keys: Iterable[str]) -> dict[str, int]:
        """Bytes of those that are there, of a request for the head of each."""
        import obstore

        def length(key: str) -> int | None:
            try:
                with self.in_words():
                    return int(self._asked(lambda objects: obstore.head(objects, key))["size"])
            except FileNotFoundError:
                return None

        asked = list(keys)
        with ThreadPoolExecutor(READERS) as readers:
            found = zip(asked, readers.map(length, asked), strict=True)
            return {key: size for key, size in found if size is not None}

    def _listing(self, folder: str) -> dict[str, int]:
        import obstore

        with self.in_words():
            return self._asked(
                lambda objects: {
                    meta["path"]: meta["size"] for page in obstore.list(objects, folder) for meta in page
                }
            )

    def create(self, key: str, content: bytes) -> bool:
        """A conditional put."""
        return self._put(key, content, "create")

    def write(self, key: str, content: bytes) -> None:
        """A put."""
        self._put(key, content, "overwrite")

    def _put(self, key: str, content: bytes, mode: Literal["create", "overwrite"]) -> bool:
        import obstore

        with self.in_words():
            try:
                self._asked(lambda objects: obstore.put(objects, key, content, mode=mode))
            except obstore.exceptions.AlreadyExistsError:
                return False
            except FileNotFoundError as error:  # no object can be missing here, only the bucket
                raise obstore.exceptions.GenericError(str(error)) from error
        return True

    def delete(self, key: str) -> None:
        """One request."""
        self._delete([key])

    def remove(self, folder: str) -> None:
        """A listing, then bulk deletions."""
        self._delete(self.keys(folder))

    def _delete(self, keys: list[str]) -> None:
        import obstore

        if keys:
            with self.in_words():
                self._asked(lambda objects: obstore.delete(objects, keys))

    def store(self, folder: str, read_only: bool = False) -> Store:
        """Zarr's own, over obstore; its errors in our words."""
        from zarr.storage import ObjectStore

        store = ObjectStore(self._below(folder), read_only=read_only)
        return PatientStore(store, self.in_words, _may_pass, PATIENCE.total_seconds())

    def found(self, objects: Mapping[str, bytes], last: str) -> None:
        """One after another, none over another's."""
        strange = sorted(set(self.keys("")) - set(objects))
        if strange and not self.exists(last):
            raise SettingsMismatchError(f"{self} holds {strange[0]} but no run; choose another --out")
        for key, content in objects.items():
            if key != last and not self.create(key, content) and self.read(key) != content:
                raise SettingsMismatchError(
                    f"{self} holds the beginning of a run with another {key}: one of other settings, killed early "
                    "or beginning now in another process. Choose another --out, or remove it"
                )
        self.confirm({key: len(content) for key, content in objects.items() if key != last})
        self.check_exclusive(next(key for key in objects if key != last))
        self.create_record(last, objects[last])

    @contextmanager
    def held(self, clear: Callable[[], None]) -> Iterator[None]:
        """Nothing is locked."""
        clear()
        yield

    @contextmanager
    def one_at_a_time(self) -> Iterator[None]:
        """No lock: a second process writes the same bytes once more."""
        yield

    @contextmanager
    def tended(self, folder: str) -> Iterator[None]:  # noqa: ARG002 - nothing lies aside in an object store
        """No lock: files of other content have other names, and the last head counts."""
        yield

    def derived(self, folder: str, stamp: str) -> str:
        """A folder per stamp."""
        return f"{folder}/{stamp[:STAMP_DIGITS]}"

    @contextmanager
    def rebuilding(self, folder: str, stamp: str) -> Iterator[Store]:
        """In its final place, which is not read before its stamp is written, and as if nothing were there.

        Two processes that build it at once write the same bytes, and neither removes what the other wrote.
        """
        here = self.derived(folder, stamp)
        yield BlankStore(self.store(here))
        self._delete([key for key in self.keys(folder) if not key.startswith(f"{here}/")])


def _may_pass(error: StoreError) -> bool:
    """Whether the store failed, and did not refuse."""
    from obstore.exceptions import GenericError

    return isinstance(error.__cause__, GenericError)


class _Ranges(RawIOBase):
    """What obstore can read of an object here and there, as Python's own file type."""

    def __init__(self, file: "ReadableFile", bucket: Bucket) -> None:
        self._file, self._bucket = file, bucket

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        with self._bucket.in_words():
            content = self._file.read(len(buffer))
        buffer[: len(content)] = bytes(content)
        return len(content)
