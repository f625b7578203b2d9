"""Where probes are fitted: this process, processes, or a Ray cluster."""
