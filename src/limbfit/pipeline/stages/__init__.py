"""The chain of stages, and the inputs and records that they read and judge."""
