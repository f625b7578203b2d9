"""Sources of observations: the scene, recordings, environments, pictures; one file each, and `source` for all."""
