"""`probe-kit check-adapter`: the contract of adapters in plain English, and a run of two episodes."""
