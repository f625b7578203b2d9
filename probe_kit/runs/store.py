"""The location of a run, from the path or URL that the user gave."""

from pathlib import Path

from probe_kit.errors import UsageError
from probe_kit.runs.bucket import Bucket
from probe_kit.runs.folder import Folder
from probe_kit.runs.location import Location

__all__ = ["SCHEMES", "Location", "locate"]

SCHEMES = ("s3", "gs", "az")


def locate(where: str | Path | Location) -> Location:
    """The location at a folder or a URL such as `s3://bucket/prefix/run`.

    Raises MissingExtraError for a URL without the extra `remote`, and UsageError for one of another kind.
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
