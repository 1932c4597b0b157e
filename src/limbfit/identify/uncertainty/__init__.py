"""What the data cannot tell: noise and misfit, intervals, samples, profiles, other sources."""
