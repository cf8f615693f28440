"""What a film is like: its noise, what its curve hides, and windows cut from it."""
