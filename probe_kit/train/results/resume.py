"""Checkpoints of an interrupted sweep: probes of single sites, from which the same command resumes."""

from collections.abc import Mapping
from dataclasses import dataclass

from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.layout import PROBES
from probe_kit.runs.resume_pieces import Pieces
from probe_kit.runs.store import Location
from probe_kit.train.crossval.site_probe import SiteProbe


@dataclass(frozen=True)
class SweepCheckpoint:
    """Probes of single sites, kept until the sweep they belong to is complete."""

    pieces: Pieces

    @classmethod
    def of(cls, run: Location, key: str, stamp: str = "") -> "SweepCheckpoint":
        """Return the checkpoints of the sweep with the key `key`. stamp: hash of the commits that it reads."""
        return cls(Pieces.of(run, PROBES, key, stamp, "the same `probe-kit train` then probes the site again"))

    @property
    def folder(self) -> str:
        """The folder of the checkpoints in the run."""
        return self.pieces.folder

    def read(self, view: str, site: Site) -> dict[str, SiteProbe] | None:
        """The probes of a site by category, or None if the sweep did not get that far.

        Raises RunDamagedError if they were changed, or are of another site or of other commits.
        """
        arrays = self.pieces.read(f"{view}+{site}")
        if arrays is None:
            return None
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
        self.pieces.keep(f"{view}+{site}", arrays)

    def discard(self) -> None:
        """Remove everything: the sweep is complete."""
        self.pieces.discard()
