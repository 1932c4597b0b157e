"""Images from DICOM series and NIfTI files: voxels, geometry, units."""
