"""Image swap: swap the two images and see which one the action follows."""
