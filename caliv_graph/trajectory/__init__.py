"""The vehicle's trajectory: smoothed from raw sensors, or from given poses; motion compensation.

`select` decides which; `smoothing` builds and solves the graph, `smoothed` is what it offers. Below
them: `imu`, `gnss`, `measurements` and `noise` make of raw data what `factors` take, `initial` is
where the solution starts, `chain` its information. `deskew` and `heading` use the trajectory.
"""
