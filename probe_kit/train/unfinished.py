"""What an interrupted sweep left: probes of single sites, from which the same command continues."""

from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from zipfile import ZipFile

import numpy as np

from probe_kit.errors import RunDamagedError
from probe_kit.extract.store.bundles import PARTIAL
from probe_kit.extract.store.hashes import DIGEST_BYTES, digest
from probe_kit.extract.store.layout import PROBES
from probe_kit.extract.store.location import Location
from probe_kit.hooks.sites import Site
from probe_kit.train.probe import SiteProbe

_HEX = 2 * DIGEST_BYTES


@dataclass(frozen=True)
class Unfinished:
    """Probes of single sites, kept until the sweep they belong to is complete."""

    run: Location
    folder: str
    stamp: str

    @classmethod
    def of(cls, run: Location, key: str, stamp: str = "") -> "Unfinished":
        """Those of the sweep that will be stored as `key`. stamp: hash of the commits that it reads."""
        return cls(run, f"{PROBES}/.{key}{PARTIAL}", stamp)

    def read(self, view: str, site: Site) -> dict[str, SiteProbe] | None:
        """The probes of a site by category, or None if the sweep did not get that far.

        Raises RunDamagedError if they were changed, or are of another site or of other commits.
        """
        try:
            stored = self.run.read(self._key(view, site))
        except FileNotFoundError:
            return None
        content, bound = stored[:-_HEX], stored[-_HEX:]
        if self._bound(content, view, site) != bound:
            raise RunDamagedError(
                f"{self.run}/{self._key(view, site)} was changed after it was written, or is of another site or "
                "of other episodes. Remove it; the same `probe-kit train` then probes the site again"
            )
        with np.load(BytesIO(stored), allow_pickle=False) as arrays:
            return {
                category: SiteProbe(**{part: arrays[f"{category}/{part}"] for part in SiteProbe.__annotations__})
                for category in dict.fromkeys(name.rsplit("/", 1)[0] for name in arrays)
            }

    def keep(self, view: str, site: Site, probes: Mapping[str, SiteProbe]) -> None:
        """Store the probes of a site by category."""
        arrays = {
            f"{category}/{part}": array
            for category, probe in probes.items()
            for part, array in vars(probe).items()
        }
        file = BytesIO()
        np.savez(file, allow_pickle=False, **arrays)
        with ZipFile(file, "a") as archive:
            archive.comment = bytes(_HEX)  # a zip file may end in a comment: that is where the hash goes
        content = file.getvalue()[:-_HEX]
        self.run.write(self._key(view, site), content + self._bound(content, view, site))

    def _bound(self, content: bytes, view: str, site: Site) -> bytes:
        """Hash of the file and of what it is, _HEX bytes."""
        return digest(f"{self._key(view, site)} {self.stamp} ".encode() + content).encode()

    def discard(self) -> None:
        """Remove everything: the sweep is complete."""
        self.run.remove(self.folder)

    def _key(self, view: str, site: Site) -> str:
        return f"{self.folder}/{view}+{site}.npz"


def unfinished_sweeps(run: Location) -> dict[str, int]:
    """Number of finished sites of every sweep that was interrupted or failed, by the key its results will have."""
    parts = (key.split("/") for key in run.keys(PROBES))
    names = [own[1] for own in parts if len(own) > 2 and own[1].startswith(".") and own[1].endswith(PARTIAL)]
    return {name[1:].removesuffix(PARTIAL): names.count(name) for name in dict.fromkeys(names)}
