"""The records of a study: read, checked, and compared with what a simulation gives."""
