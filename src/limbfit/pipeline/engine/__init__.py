"""What stages and experiments stand on: the store and its keys, the files in it, progress, provenance."""
