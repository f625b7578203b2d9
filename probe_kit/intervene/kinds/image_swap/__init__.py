"""Image swap: exchange the two pictures and see which one the action follows."""
