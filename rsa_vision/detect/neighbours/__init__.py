"""Balls beside, under and over something else: other balls, edges, lines, dust."""
