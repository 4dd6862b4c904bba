"""The motion of a vehicle that recorded nothing but LiDARs, from what stands still."""
