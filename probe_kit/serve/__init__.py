"""A policy server whose clients play: activations behind the sockets of benchmarks and robots."""
