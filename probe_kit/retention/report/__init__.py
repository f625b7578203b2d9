"""The HTML report: one file that needs no network, to look at, sort, filter and cite."""

from probe_kit.retention.report.page import report_html, write_report

__all__ = ["report_html", "write_report"]
