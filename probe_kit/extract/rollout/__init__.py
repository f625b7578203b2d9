"""Playing episodes: a stage with one environment, who decides on it, and the worker that commits them."""
