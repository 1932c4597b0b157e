"""Inputs of FEBio read as arrays, laws and conditions; nothing is solved here."""
