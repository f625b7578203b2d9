"""Optional libraries, imported when they are needed; see `probe_kit.extras`."""

from probe_kit.extras import require

__all__ = ["require"]
