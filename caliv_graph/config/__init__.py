"""The configuration: its model, and reading and writing it."""
