"""Running of a study: playing in this process, in several or on a Ray cluster, and fitting of probes."""
