"""What verbs, experiments and stages share: the store and its keys, simulations kept, provenance."""
