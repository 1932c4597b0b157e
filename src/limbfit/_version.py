"""The version, apart from the public names, so that it can be had without them."""

__version__ = "0.3.0"
