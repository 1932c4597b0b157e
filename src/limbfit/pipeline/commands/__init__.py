"""What can be asked of a study, one file a command, and the list of its stages and experiments."""
