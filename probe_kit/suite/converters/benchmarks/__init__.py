"""The source benchmarks, a module each."""
