"""What a study can be asked beyond the chain of stages: each experiment, and the catalogue of them."""
