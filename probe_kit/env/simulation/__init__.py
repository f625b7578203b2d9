"""The physics server, its camera and textures."""
