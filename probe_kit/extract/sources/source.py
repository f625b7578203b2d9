"""`Source`: where the observations of a run come from."""

from pathlib import Path
from typing import ClassVar

from probe_kit._terminal.field_options import Part


class SourceSettings(Part):
    """Settings of a source, which open it.

    kind: the name of the source in files. command: the option that a command names it with; empty for the scene.
    shows: the reason why options of other sources do not apply. subject, loads: what its options are about, and
    what is loaded of it, in words. decides:
    fields of other parts that the source itself decides.
    """

    kind: str

    command: ClassVar[str] = ""
    shows: ClassVar[str] = ""
    subject: ClassVar[str] = ""
    loads: ClassVar[str] = ""
    decides: ClassVar[tuple[str, ...]] = ()

    @property
    def name(self) -> str:
        """The name in tables."""
        return self.kind

    def steps(self) -> int:
        """Count the actions that an episode can have; 0 where nothing acts."""
        return 0

    def marks(self) -> list[str]:
        """The parts of a run's label that name the source."""
        return []

    def files(self) -> dict[str, Path]:
        """Return the files that the source reads beside its rows, by field."""
        return {}
