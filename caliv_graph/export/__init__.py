"""Calibrations in the form of those who use them: one file per consumer.

`consumers.export` is the way in; `request` holds what goes in and comes out.
"""
