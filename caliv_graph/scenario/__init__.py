"""A planned or simulated drive: its description, path, terrain and shapes."""
