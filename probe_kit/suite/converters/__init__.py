"""Converters: Act2Answer items from published benchmarks, and from sets in Act2Answer's own format."""

from probe_kit.suite.converters.candidates import (
    Act2AnswerOptions,
    CompBenchOptions,
    ConvertOptions,
    IconQaOptions,
    MmbenchOptions,
    OkVqaOptions,
    VlThinkOptions,
)
from probe_kit.suite.converters.conversion import PAPER_ITEMS, PAPER_POOL, SOURCES, convert
from probe_kit.suite.converters.rewriting import rewrite

__all__ = [
    "PAPER_ITEMS",
    "PAPER_POOL",
    "SOURCES",
    "Act2AnswerOptions",
    "CompBenchOptions",
    "ConvertOptions",
    "IconQaOptions",
    "MmbenchOptions",
    "OkVqaOptions",
    "VlThinkOptions",
    "convert",
    "rewrite",
]
