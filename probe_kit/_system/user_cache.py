"""The folder of this user in which probe_kit keeps what it can make again."""

import os
from pathlib import Path


def user_cache() -> Path:
    """Return `$PROBE_KIT_CACHE`, else `~/.cache/probe_kit`, which may not exist yet."""
    return Path(os.environ.get("PROBE_KIT_CACHE") or Path.home() / ".cache" / "probe_kit")
