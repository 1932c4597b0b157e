"""Label maps: read, checked, named, placed on the grid of an image, judged."""
