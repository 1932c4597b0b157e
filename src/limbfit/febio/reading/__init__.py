"""Inputs of FEBio as arrays, laws and conditions; nothing is solved here."""
