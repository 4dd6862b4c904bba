"""Sentences for users about findings: directions, contradictions, symmetries, time offsets."""
