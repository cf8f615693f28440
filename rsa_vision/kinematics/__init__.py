"""Markers of several examinations -> motion, growth, precision: pure functions on tables of markers."""
