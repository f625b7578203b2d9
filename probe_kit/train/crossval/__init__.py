"""Cross-validated probes of one site and category."""
