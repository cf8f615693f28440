"""Names for marker images: the marks of the cage on a film, and object markers across foci."""
