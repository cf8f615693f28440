"""Pointed pins and tees: fits, one by one and of a whole film."""
