"""The contract of adapters as checks: plain functions that `hooks.testing` and `probe-kit check-adapter` run."""
