"""From the study's image, labels or surfaces to the sites on the limb and the mesh of each."""
