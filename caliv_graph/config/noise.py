"""The noise of each sensor, as far as the user states it."""

from __future__ import annotations

from pydantic import Field

from caliv_graph.config.sections import Fine, NonNegative, Positive, Section


class NoiseConfig(Section):
    """Noise of each sensor, 1 sigma. Absent: message covariances, else the paper's table."""

    lidar_range_m: Fine = Field(0.01, description="metres, along the beam, at least")
    lidar_range_bias_m: Positive | None = Field(
        None,
        description="metres, how much all ranges of a LiDAR on one target, on walls and on the "
        "ground are off, 1 sigma; absent: integrated over or estimated, with the millimetres of "
        "data sheets as the prior",
    )
    lidar_ground_tilt_deg: Positive | None = Field(
        None,
        description="degrees, 1 sigma of the tilt in which each LiDAR sees all ground of a drive "
        "against the plane that carries the wheels; absent: none on roads, by its roughness on "
        "grass and gravel",
    )
    lidar_ground_height_m: Positive | None = Field(
        None,
        description="metres, 1 sigma of how much higher or lower each LiDAR sees all ground of a "
        "drive than others do; absent: none on roads, by its roughness on grass and gravel",
    )
    pose_position_m: Positive | None = Field(
        None,
        description="metres, white error of each given pose; absent: its message, or fitted",
    )
    pose_rotation_deg: Positive | None = Field(
        None,
        description="degrees, white error of each given pose; absent: its message, or fitted",
    )
    pose_drift_position_m: Positive | None = Field(
        None, description="metres, slowly varying error of the given poses over the drive"
    )
    pose_drift_rotation_deg: Positive | None = Field(
        None, description="degrees, slowly varying error of the given poses over the drive"
    )
    pose_time_offset_s: NonNegative = Field(
        0.02,
        description="seconds, 1 sigma of the stamps of given poses less the true times, in the "
        "clock of the LiDARs, where they are not synchronised; 0: exact",
    )
    pose_drift_time_s: Positive | None = Field(
        None,
        description="seconds, correlation time of the slowly varying error of given poses; absent: "
        "fitted",
    )
    accelerometer_density_m_s2_sqrthz: Positive | None = None
    gyroscope_density_rad_s_sqrthz: Positive | None = None
    accelerometer_bias_walk_m_s3_sqrthz: Positive | None = None
    gyroscope_bias_walk_rad_s2_sqrthz: Positive | None = None
    accelerometer_bias_m_s2: Positive = Field(
        0.1, description="m/s^2, constant bias of the accelerometer, per axis"
    )
    gyroscope_bias_rad_s: Positive = Field(
        0.01, description="rad/s, constant bias of the gyroscope, per axis"
    )
    gnss_horizontal_m: Positive | None = None
    gnss_vertical_m: Positive | None = None
    gnss_correlated_horizontal_m: NonNegative | None = Field(
        None,
        description="metres, first-order Gauss-Markov error of the fixes, east and north alike; "
        "absent: estimated; 0: none",
    )
    gnss_correlated_vertical_m: NonNegative | None = Field(
        None, description="metres, the same, up; absent while the other is given: none"
    )
    gnss_correlation_s: Positive | None = Field(
        None, description="seconds, its correlation time; absent: estimated"
    )
    orientation_correlated_deg: NonNegative | None = Field(
        None,
        description="degrees, first-order Gauss-Markov error of the IMU's orientation, about every "
        "map axis; absent: estimated, and none about level axes while that of the yaw is given; "
        "0: none",
    )
    orientation_correlated_yaw_deg: NonNegative | None = Field(
        None, description="degrees, the same about the vertical; absent: as about the others"
    )
    orientation_correlation_s: Positive | None = Field(
        None, description="seconds, its correlation time; absent: estimated"
    )
    heave_m: Positive | None = Field(
        None,
        description="metres, lift of the body on its springs at each stamp; absent: estimated",
    )
    sway_deg: Positive = Field(
        0.057,
        description="degrees, tilt of the body at each stamp from its mean over the drive, per "
        "axis; used with ground.parallel_sigma_deg",
    )
    ground_normal_deg: Positive | None = Field(
        None,
        description="degrees, tilt of the ground around a LiDAR from the plane of the drive, from "
        "scan to scan; absent: estimated",
    )
    ground_distance_m: Positive | None = Field(
        None,
        description="metres, height of the ground below a LiDAR over that plane, from scan to "
        "scan; absent: estimated",
    )
    velocity_m_s: Positive | None = None
    yaw_rate_rad_s: Positive | None = Field(
        None, description="rad/s, yaw rate of the odometry, used where there is no IMU"
    )
    heading_deg: Positive | None = Field(
        None, description="degrees, each heading of topics.heading; absent: its message, or 0.3"
    )
    orientation_deg: Positive | None = None
