"""Pure mathematics of projections: homography, lines, resection, cameras. Arrays in, new arrays out."""
