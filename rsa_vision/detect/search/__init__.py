"""Where marker images may be: a cheap filter over the film in bands, recall first."""
