"""What marks look like on a film: balls, needles, and two of them in one beam."""
