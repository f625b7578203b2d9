"""Plans of a suite in the scene, without a model."""

from collections.abc import Sequence
from typing import Any

from probe_kit.env import SceneSpec
from probe_kit.extract.sources.scene import SceneSettings
from probe_kit.extract.sources.scene_source import SceneSource
from probe_kit.runs.layout import LaterViews, StoredStream
from probe_kit.runs.plan import Plan, Row
from probe_kit.suite import Suite


def scene_rows(suite: Suite, seed: int = 0, wordings: Sequence[str] | None = None) -> tuple[Row, ...]:
    """The rows of a suite, in some wordings."""
    chosen_wordings: Any = None if wordings is None else tuple(wordings)
    return SceneSource(SceneSettings(wordings=chosen_wordings, scene=SceneSpec()), suite).rows(seed)


def make_plan(
    suite: Suite,
    streams: Sequence[StoredStream],
    seed: int,
    calls: int,
    with_tokens: bool,
    wordings: Sequence[str] | None = None,
    later_views: LaterViews = "all",
) -> Plan:
    """The plan of a suite whose episodes store these streams."""
    chosen_wordings: Any = None if wordings is None else tuple(wordings)
    source = SceneSource(SceneSettings(wordings=chosen_wordings, scene=SceneSpec()), suite)
    rows = source.rows(seed)
    size = sum(stream.raw_bytes(with_tokens, calls, later_views) for stream in streams) * len(rows)
    identity = {"suite": source.identity(1)["suite"]}
    return Plan(
        rows, tuple(streams), size, identity, source.selection(rows), source.name_parts(), source.suite_parent
    )
