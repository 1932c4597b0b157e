"""The calibration, what it predicts at every site, and other choices of the fitted sites."""
