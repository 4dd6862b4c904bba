"""The ground in each scan.

`fit`: a plane by RANSAC, under a target. `surface`: the ground of a whole scan, with ramps and
kerbs. `planes`: the plane about the LiDAR with its covariance. `measure`: such planes of a drive.
"""
