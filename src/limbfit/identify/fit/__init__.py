"""The search: parameters, residuals, least squares in stages, several starts, corrections by fine meshes."""
