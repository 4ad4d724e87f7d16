"""To look at runs: a page with picture, map, sound and lanes on one clock, live or kept, and films."""
