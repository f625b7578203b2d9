"""SmolVLA through lerobot."""
