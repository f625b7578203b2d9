"""Playing episodes: players of sources, controllers, and the worker that commits episodes."""
