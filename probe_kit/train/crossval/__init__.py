"""Cross-validated probes of one site and one category."""
