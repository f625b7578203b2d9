"""A policy server whose clients play: activations behind the sockets that benchmarks and robots speak."""
