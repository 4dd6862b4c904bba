"""A planned or simulated drive: its description, path, terrain, world and beams."""
