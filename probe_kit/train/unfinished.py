"""What an interrupted sweep left: probes of single sites, from which the same command continues."""

from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO

import numpy as np

from probe_kit.extract.store.location import Location
from probe_kit.hooks.sites import Site
from probe_kit.train.probe import SiteProbe
from probe_kit.train.store import HOME

SUFFIX = ".partial"


@dataclass(frozen=True)
class Unfinished:
    """Probes of single sites, kept until the sweep they belong to is complete."""

    run: Location
    folder: str

    @classmethod
    def of(cls, run: Location, key: str) -> "Unfinished":
        """Those of the sweep that will be stored as `key`."""
        return cls(run, f"{HOME}/.{key}{SUFFIX}")

    def read(self, view: str, site: Site) -> dict[str, SiteProbe] | None:
        """The probes of a site by category, or None if the sweep did not get that far."""
        try:
            stored = self.run.read(self._key(view, site))
        except FileNotFoundError:
            return None
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
        content = BytesIO()
        np.savez(content, allow_pickle=False, **arrays)
        self.run.write(self._key(view, site), content.getvalue())

    def discard(self) -> None:
        """Remove everything: the sweep is complete."""
        self.run.remove(self.folder)

    def _key(self, view: str, site: Site) -> str:
        return f"{self.folder}/{view}+{site}.npz"


def unfinished_sweeps(run: Location) -> dict[str, int]:
    """Number of finished sites of every sweep that was interrupted or failed, by the key its results will have."""
    parts = (key.split("/") for key in run.keys(HOME))
    names = [own[1] for own in parts if len(own) > 2 and own[1].startswith(".") and own[1].endswith(SUFFIX)]
    return {name[1:].removesuffix(SUFFIX): names.count(name) for name in dict.fromkeys(names)}
