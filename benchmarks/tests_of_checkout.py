"""Make `tests` of this checkout importable: it is no installed package, and an installed one may have its name."""

import sys
import types
from pathlib import Path

sys.modules["tests"] = types.ModuleType("tests")
sys.modules["tests"].__path__ = [str(Path(__file__).parents[1] / "tests")]
