"""The HTML report: one file that needs no network, to look at, sort, filter and cite."""

from probe_kit.retention.report.label_page import label_report_html, write_label_report
from probe_kit.retention.report.page import report_html, write_report

__all__ = ["label_report_html", "report_html", "write_label_report", "write_report"]
