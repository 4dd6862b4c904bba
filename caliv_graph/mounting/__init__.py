"""Where the LiDARs sit on the vehicle, found from a drive without an initial guess."""
