"""Where the limb is indented: given positions, skin markers, registration of two scans."""
