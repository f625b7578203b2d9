"""Converters: Act2Answer items from five published benchmarks, which stay where their owners put them."""

from probe_kit.suite.converters.conversion import PAPER_ITEMS, PAPER_POOL, SOURCES, convert
from probe_kit.suite.converters.options import (
    CompBenchOptions,
    ConvertOptions,
    IconQaOptions,
    MmbenchOptions,
    OkVqaOptions,
    VlThinkOptions,
)
from probe_kit.suite.converters.rewriting import rewrite

__all__ = [
    "PAPER_ITEMS",
    "PAPER_POOL",
    "SOURCES",
    "CompBenchOptions",
    "ConvertOptions",
    "IconQaOptions",
    "MmbenchOptions",
    "OkVqaOptions",
    "VlThinkOptions",
    "convert",
    "rewrite",
]
