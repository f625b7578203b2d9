"""Which pictures `probe-kit train` holds a run against when none are named."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from probe_kit.suite.build import default_folder
from probe_kit.train.commands import _embedded_suite


def test_the_embedded_suite_is_used_only_where_it_was_built(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Drawing 1,650 items would be a surprise in the middle of fitting probes."""
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path))
    run = SimpleNamespace(suite="a2a-embedded@1.0.0#0123456789ab")
    assert _embedded_suite(run) is None  # type: ignore[arg-type]
    assert not default_folder().exists()
    assert _embedded_suite(SimpleNamespace(suite="mine@1#0")) is None  # type: ignore[arg-type]
