"""The vehicle's trajectory: smoothed from raw sensors, or from given poses; motion compensation.

`select` chooses between `smooth` and `given`. `smooth` calls one stage after the other: `inputs`
(check), `nodes` (place, carry measurements), `initial` and `alignment` (initial guess), `build`
(the graph, of `factors`), `solve`, `outliers`; `smoothed` is the result. `imu`, `gnss`,
`measurements`, `noise`, `chain` and `marginals` are their parts. `deskew` and `heading` use a
trajectory. `README.md` has the mathematics.
"""
