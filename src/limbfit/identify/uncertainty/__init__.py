"""What the records leave open: noise and misfit, intervals, samples, profiles, comparison of models."""
