"""Controls: what probes read where no answer can be known."""
