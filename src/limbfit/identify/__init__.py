"""Parameter identification: calibration, uncertainty, prediction and the checks of records.

The room works on arrays and on simulations that are handed in as functions; it knows no study and no mesh.
"""
