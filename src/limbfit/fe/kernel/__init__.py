"""Compiled element kernels, the table of elements, the laws of all cells."""
