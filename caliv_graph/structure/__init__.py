"""Walls and other flat structure as evidence: patches of surface, strips, what they determine."""
