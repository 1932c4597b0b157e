"""Records that cannot be right, other choices of sites, sites worth testing."""
