"""The stored results of a study: one model for each JSON file, which `docs/results.md` is made from."""
