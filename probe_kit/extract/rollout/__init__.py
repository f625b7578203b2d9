"""Playing episodes: environments (stages), controllers, and the worker that commits episodes."""
