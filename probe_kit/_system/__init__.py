"""Files, machines and optional libraries."""
