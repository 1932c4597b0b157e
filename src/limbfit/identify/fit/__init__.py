"""The search: parameters, residuals, least squares, stages, several starts, two meshes."""
