"""Partial results of unfinished work: arrays with the key of their owner, from which the same command resumes."""

from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import open_arrays
from probe_kit.errors import RunDamagedError
from probe_kit.runs.records import DIGEST_BYTES, digest
from probe_kit.runs.results import PARTIAL
from probe_kit.runs.store import Location

_HEX = 2 * DIGEST_BYTES


@dataclass(frozen=True)
class Pieces:
    """The content of `<home>/.<key>.partial/` until the bundle `key` is complete.

    stamp: hash of the commits that the work reads. redo: what to do about a damaged piece, for the message.
    """

    run: Location
    folder: str
    stamp: str
    redo: str

    @classmethod
    def of(cls, run: Location, home: str, key: str, stamp: str, redo: str) -> "Pieces":
        """Return the pieces of the bundle that will be stored as `home`/`key`."""
        return cls(run, f"{home}/.{key}{PARTIAL}", stamp, redo)

    def read(self, name: str) -> dict[str, NDArray[Any]] | None:
        """The arrays of one piece, or None if the work did not get that far.

        Raises RunDamagedError if they were changed, or are another piece's or of other commits.
        """
        try:
            stored = self.run.read(self._key(name))
        except FileNotFoundError:
            return None
        content, bound = stored[:-_HEX], stored[-_HEX:]
        if self._bound(content, name) != bound:
            raise RunDamagedError(
                f"{self.run}/{self._key(name)} was changed after it was written, or is another piece or of other "
                f"episodes. Remove it; {self.redo}"
            )
        with open_arrays(stored) as arrays:
            return dict(arrays)

    def keep(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Store one piece."""
        file = BytesIO()
        np.savez(file, allow_pickle=False, **arrays)
        with ZipFile(file, "a") as archive:
            archive.comment = bytes(_HEX)  # a zip file may end in a comment: that is where the hash goes
        content = file.getvalue()[:-_HEX]
        # Not flushed: a piece that a power cut takes is computed again, and its hash shows half a one.
        self.run.write(self._key(name), content + self._bound(content, name), durable=False)

    def discard(self) -> None:
        """Remove everything: the work is complete."""
        self.run.remove(self.folder)

    def _bound(self, content: bytes, name: str) -> bytes:
        """Hash of the file and of what it is, _HEX bytes."""
        return digest(f"{self._key(name)} {self.stamp} ".encode() + content).encode()

    def _key(self, name: str) -> str:
        return f"{self.folder}/{name}.npz"
