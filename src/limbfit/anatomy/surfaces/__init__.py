"""Triangle surfaces: extracted from voxels, read, mended, their distances."""
