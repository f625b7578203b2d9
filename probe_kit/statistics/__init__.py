"""What suite gates, probes and success rates share: grouped folds, intervals, margins, the level of a test."""
