"""What is asked of a study: one file for each."""
