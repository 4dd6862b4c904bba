"""Jobs around the calibration: surveying a drive, repeating it by halves, drafting a config."""
