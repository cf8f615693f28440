"""Balls one by one: fits, what balls of a film have in common, and whether a fit is a ball."""
