"""Playing of environments of the user's own: their stage, and the controller that acts in them."""
