"""IMU, GNSS and velocity against the laws of motion, and their noise against what is stated."""

import itertools
import math
from typing import Any

import numpy as np
import pymap3d
import pytest
from scipy.spatial.transform import Rotation

from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import ConfigError
from caliv_graph.products import Array, GnssFixes, ImuSamples, TwistSamples
from caliv_graph.scenario.drive_models import (
    ArcDrive,
    DriveModel,
    FigureEightDrive,
    SCurveDrive,
    StandstillDrive,
    StraightDrive,
)
from caliv_graph.scenario.drives import make_drive, sample_stamps
from caliv_graph.scenario.model import BagModel
from caliv_graph.scenario.sensor_models import (
    GnssModel,
    ImuModel,
    JumpModel,
    LidarModel,
    OrientationModel,
    OutageModel,
    VelocityModel,
)
from caliv_graph.scenario.terrain import Terrain, Waves, make_terrain
from caliv_graph.scenario.world_models import ChairModel, GroundModel, RampModel, WorldModel
from caliv_graph.simulation import Scenario, SimulatedRecording, simulate_drive
from caliv_graph.simulation.motion import angular_acceleration, true_imu

RAMPS = (
    RampModel(xy_m=(9.0, -7.0), yaw_deg=250.0, height_m=0.5, flank_m=5.0, top_m=2.0, width_m=4.0),
    RampModel(xy_m=(-6.0, 9.0), yaw_deg=30.0, height_m=0.3, flank_m=4.0, width_m=5.0),
)

DRIVES: dict[str, tuple[DriveModel, tuple[RampModel, ...]]] = {
    "arc": (ArcDrive(duration_s=17.0), ()),
    "s_curve": (SCurveDrive(duration_s=17.0), ()),
    "figure_eight": (FigureEightDrive(start_yaw_deg=40.0), ()),
    "straight": (StraightDrive(duration_s=17.0), ()),
    "standstill": (StandstillDrive(duration_s=17.0), ()),
    "ramp": (FigureEightDrive(), RAMPS),
    "ramp slowly": (FigureEightDrive(speed_m_s=1.4, turn="left"), RAMPS),
}

MOUNTED = PoseConfig(xyz=(1.2, -0.4, 0.9), rpy_deg=(3.0, -4.0, 100.0))

GRAVITY = 9.80665


def scenario_of(name: str = "arc", **sections: Any) -> Scenario:
    drive, ramps = DRIVES[name]
    return Scenario(
        name=name.replace(" ", "_"),
        drive=drive,
        lidars={"front": LidarModel(mounting=PoseConfig(xyz=(2.0, 0.0, 2.0)))},
        world=WorldModel(
            ground=GroundModel(height_m=0.4, ramps=ramps),
            objects={"chair": ChairModel(xy_m=(15.0, -9.0))},
            targets=("chair",),
        ),
        **sections,
    )


def quiet_imu(**sections: Any) -> ImuModel:
    return ImuModel(
        accelerometer_sigma_m_s2=0.0,
        gyroscope_sigma_rad_s=0.0,
        orientation=OrientationModel(sigma_rad=0.0),
        **sections,
    )


def imu_of(recording: SimulatedRecording) -> ImuSamples:
    imu = recording.motion().imu
    assert imu is not None
    return imu


def gnss_of(recording: SimulatedRecording) -> GnssFixes:
    gnss = recording.motion().gnss
    assert gnss is not None
    return gnss


def twist_of(recording: SimulatedRecording) -> TwistSamples:
    twist = recording.motion().twist
    assert twist is not None
    return twist


def enu_of(recording: SimulatedRecording) -> Array:
    gnss = gnss_of(recording)
    enu = pymap3d.geodetic2enu(
        gnss.latitude_deg, gnss.longitude_deg, gnss.altitude_m, *recording.truth.datum
    )
    return np.column_stack(enu)


def integrated(imu: ImuSamples, R: Array, t: Array, v: Array) -> tuple[Array, Array]:
    """Orientations and positions of the IMU in the map from what it says and a start alone."""
    dt = np.diff((imu.stamps_ns - imu.stamps_ns[0]) * 1e-9)[:, None]
    before, after = imu.angular_velocity[:-1], imu.angular_velocity[1:]
    # The second order of what two rates that differ do (coning).
    turns = 0.5 * (before + after) * dt + np.cross(before, after) * dt**2 / 12
    steps = Rotation.from_rotvec(turns).as_matrix()
    rotations = np.array(list(itertools.accumulate(steps, np.matmul, initial=R)))
    force_map = np.einsum("nij,nj->ni", rotations, imu.specific_force)
    acceleration = 0.5 * (force_map[:-1] + force_map[1:]) - [0.0, 0.0, GRAVITY]
    velocities = v + np.vstack([np.zeros(3), np.cumsum(acceleration * dt, axis=0)])
    moves = velocities[:-1] * dt + 0.5 * acceleration * dt**2
    return rotations, t + np.vstack([np.zeros(3), np.cumsum(moves, axis=0)])


@pytest.mark.parametrize("name", DRIVES)
@pytest.mark.parametrize(
    "mounting", [PoseConfig(xyz=(0.0, 0.0, 0.0)), MOUNTED], ids=["base", "arm"]
)
def test_perfect_imu_integrated_from_the_true_start_follows_the_whole_drive(
    name: str, mounting: PoseConfig
) -> None:
    recording = simulate_drive(scenario_of(name, imu=quiet_imu(mounting=mounting)), 0)
    imu, truth = imu_of(recording), recording.truth
    states = truth.states(imu.stamps_ns)
    T_vehicle_imu = mounting.pose()
    R_true = states.R_map_vehicle @ T_vehicle_imu.rotation().matrix()
    t_true = states.position_map + states.R_map_vehicle @ T_vehicle_imu.translation()

    # It starts from standstill.
    rotations, positions = integrated(imu, R_true[0], t_true[0], np.zeros(3))

    turns = Rotation.from_matrix(np.swapaxes(R_true, 1, 2) @ rotations).magnitude()
    assert turns.max() < 1e-4
    assert np.linalg.norm(positions - t_true, axis=1).max() < 0.01
    assert imu.orientation_xyzw is not None
    said = Rotation.from_quat(imu.orientation_xyzw).as_matrix()
    np.testing.assert_allclose(said, R_true, atol=1e-12)


@pytest.mark.parametrize("name", ["figure_eight", "ramp"])
def test_states_are_derivatives_of_one_another(name: str) -> None:
    model, ramps = DRIVES[name]
    drive = make_drive(model, make_terrain(GroundModel(ramps=ramps)))
    stamps_ns = np.arange(0, 50_000_000_000, 97_000_000, dtype=np.int64)
    step_ns = 100_000
    s = drive.states(stamps_ns)
    before, after = drive.states(stamps_ns - step_ns), drive.states(stamps_ns + step_ns)
    over = 1e9 / (2.0 * step_ns)
    velocity = (after.position_map - before.position_map) * over
    np.testing.assert_allclose(velocity, s.velocity_map, atol=1e-6)
    acceleration = (after.velocity_map - before.velocity_map) * over
    np.testing.assert_allclose(acceleration, s.acceleration_map, atol=1e-6)
    R_rate = (after.R_map_vehicle - before.R_map_vehicle) * over
    spin = np.einsum("nji,njk->nik", s.R_map_vehicle, R_rate)
    rate = np.column_stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]])
    np.testing.assert_allclose(rate, s.angular_velocity, atol=1e-6)
    np.testing.assert_allclose(
        np.einsum("nji,njk->nik", s.R_map_vehicle, s.R_map_vehicle),
        np.tile(np.eye(3), (len(stamps_ns), 1, 1)),
        atol=1e-12,
    )
    coarse = (
        drive.states(stamps_ns + 1_000_000).angular_velocity
        - drive.states(stamps_ns - 1_000_000).angular_velocity
    ) * 500.0
    np.testing.assert_allclose(angular_acceleration(drive, stamps_ns), coarse, atol=1e-4)


def test_vehicle_on_a_ramp_lies_in_the_plane_that_touches_the_ground() -> None:
    model, ramps = DRIVES["ramp"]
    terrain = Terrain(ramps)
    states = make_drive(model, terrain).states(np.arange(0, 58, dtype=np.int64) * 10**9)
    heights, _, _ = terrain.heights(states.position_map[:, :2])
    np.testing.assert_allclose(states.position_map[:, 2], heights, atol=1e-12)
    # A step in the vehicle's own x or y stays on the ground, to second order of its length.
    for axis in (0, 1):
        step = states.position_map + 1e-3 * states.R_map_vehicle[:, :, axis]
        np.testing.assert_allclose(step[:, 2], terrain.heights(step[:, :2])[0], atol=1e-6)
    # Body frame: no slip sideways, no taking off.
    own = np.einsum("nji,nj->ni", states.R_map_vehicle, states.velocity_map)
    np.testing.assert_allclose(own[:, 1:], 0.0, atol=1e-12)
    pitch_deg = np.degrees(np.arcsin(-states.R_map_vehicle[:, 2, 0]))
    assert pitch_deg.min() < -4.0
    assert pitch_deg.max() > 4.0


def test_ramp_has_its_height_its_slope_and_its_ends() -> None:
    ramp = RampModel(
        xy_m=(5.0, 2.0), yaw_deg=90.0, height_m=0.8, flank_m=6.0, top_m=2.0, width_m=3.0
    )
    terrain = Terrain((ramp,))
    # Along map y: the top reaches 1 m from the middle, the flank 7 m; across it 1.5 m and 7.5 m.
    xy = np.array([[5.0, 2.0], [5.0, 3.0], [6.5, 2.9], [5.0, 6.0], [5.0, 9.0], [12.5, 2.0]])
    heights, gradient, _ = terrain.heights(xy)
    np.testing.assert_allclose(heights, [0.8, 0.8, 0.8, 0.4, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(gradient[3], [0.0, -35.0 / 16.0 * 0.8 / 6.0], atol=1e-12)
    rng = np.random.default_rng(0)
    places = rng.uniform(-6.0, 6.0, (50, 2)) + np.array([5.0, 2.0])
    h, step = Terrain((ramp, *RAMPS), Waves.drawn(0.02, 3)), 1e-4
    _, gradient, hessian = h.heights(places)
    for axis in (0, 1):
        shift = step * np.eye(2)[axis]
        up, down = h.heights(places + shift), h.heights(places - shift)
        np.testing.assert_allclose((up[0] - down[0]) / (2 * step), gradient[:, axis], atol=1e-6)
        np.testing.assert_allclose((up[1] - down[1]) / (2 * step), hessian[:, axis], atol=1e-5)


def test_waves_are_as_high_as_they_say_on_average() -> None:
    places = np.random.default_rng(0).uniform(-200.0, 200.0, (2000, 2))
    squares = [np.mean(Waves.drawn(0.003, seed).at(places)[0] ** 2) for seed in range(20)]
    # A hundred squares of waves of 40 m.
    np.testing.assert_allclose(np.sqrt(np.mean(squares)), 0.003, rtol=0.05)


def test_imu_at_rest_feels_gravity_upwards() -> None:
    recording = simulate_drive(scenario_of("standstill", imu=quiet_imu()), 0)
    np.testing.assert_allclose(imu_of(recording).specific_force, [[0.0, 0.0, GRAVITY]] * 1701)
    np.testing.assert_allclose(imu_of(recording).angular_velocity, 0.0)


def test_imu_on_an_arm_feels_the_centripetal_acceleration_there() -> None:
    # At 2 m/s on a right-hand circle of 9.16 m: 0.2183 rad/s. 1 m to the left the circle is
    # 10.16 m, and the pull to the right 0.2183^2 x 10.16 = 0.4844 m/s^2.
    model = quiet_imu(mounting=PoseConfig(xyz=(0.0, 1.0, 0.5)))
    drive = make_drive(ArcDrive(duration_s=17.0))
    rate, force, _ = true_imu(drive, model, GRAVITY, np.array([8_000_000_000]))
    np.testing.assert_allclose(rate, [[0.0, 0.0, -2.0 / 9.16]], atol=1e-12)
    pull = (2.0 / 9.16) ** 2 * 10.16
    np.testing.assert_allclose(force, [[0.0, -pull, GRAVITY]], atol=1e-6)


def test_noise_has_the_sigmas_of_the_paper() -> None:
    recording = simulate_drive(scenario_of("figure_eight"), 3)
    quiet = simulate_drive(
        scenario_of(
            "figure_eight",
            imu=quiet_imu(),
            gnss=GnssModel(horizontal_sigma_m=0.0, vertical_sigma_m=0.0),
            velocity=VelocityModel(sigma_m_s=0.0),
        ),
        3,
    )
    imu, true = imu_of(recording), imu_of(quiet)
    assert imu.orientation_xyzw is not None
    assert true.orientation_xyzw is not None
    turn = Rotation.from_quat(true.orientation_xyzw).inv() * Rotation.from_quat(
        imu.orientation_xyzw
    )
    enu = enu_of(recording) - enu_of(quiet)
    # 1.5e-7 degrees of arc on the earth's 6378 km.
    horizontal_m = math.radians(1.5e-7) * 6378e3
    assert horizontal_m == pytest.approx(GnssModel().horizontal_sigma_m, rel=1e-3)
    for errors, sigma in (
        (imu.specific_force - true.specific_force, 0.05),
        (imu.angular_velocity - true.angular_velocity, 0.005),
        (turn.as_rotvec(), 0.005),
        (enu[:, :2], horizontal_m),
        (enu[:, 2:], 0.02),
        (twist_of(recording).velocity - twist_of(quiet).velocity, 0.1),
    ):
        n = len(errors)
        assert n > 500
        for axis in errors.T:
            # Within 4 standard errors.
            assert abs(axis.mean()) < 4.0 * sigma / math.sqrt(n)
            assert abs(axis.std() / sigma - 1.0) < 4.0 / math.sqrt(2.0 * n)
            assert abs(np.corrcoef(axis[:-1], axis[1:])[0, 1]) < 4.0 / math.sqrt(n)
    assert np.diff(imu.stamps_ns).tolist() == [10_000_000] * (len(imu.stamps_ns) - 1)
    assert np.diff(gnss_of(recording).stamps_ns).tolist() == [100_000_000] * (len(enu) - 1)


def test_messages_state_the_covariance_of_the_noise_or_that_it_is_unknown() -> None:
    motion = simulate_drive(scenario_of(), 0).motion()
    assert motion.imu is not None
    assert motion.gnss is not None
    assert motion.twist is not None
    assert motion.imu.angular_velocity_cov is not None
    np.testing.assert_allclose(motion.imu.angular_velocity_cov, 0.005**2 * np.eye(3))
    assert motion.imu.specific_force_cov is not None
    np.testing.assert_allclose(motion.imu.specific_force_cov, 0.05**2 * np.eye(3))
    assert motion.imu.orientation_cov is not None
    np.testing.assert_allclose(motion.imu.orientation_cov[-1], 0.005**2 * np.eye(3))
    assert motion.gnss.cov_enu is not None
    np.testing.assert_allclose(motion.gnss.cov_enu[5], np.diag([0.0167**2, 0.0167**2, 0.02**2]))
    assert motion.twist.velocity_cov is not None
    np.testing.assert_allclose(motion.twist.velocity_cov[5], 0.1**2 * np.eye(3))

    unknown = simulate_drive(scenario_of(bag=BagModel(covariances="unknown")), 0).motion()
    assert unknown.imu is not None
    assert unknown.gnss is not None
    assert unknown.twist is not None
    assert unknown.imu.angular_velocity_cov is None
    assert unknown.imu.specific_force_cov is None
    assert unknown.imu.orientation_cov is None
    assert unknown.gnss.cov_enu is None
    assert unknown.twist.velocity_cov is None
    np.testing.assert_array_equal(unknown.imu.specific_force, motion.imu.specific_force)


def test_a_gyroscope_s_scale_and_axes_are_off_by_as_much_in_every_reading() -> None:
    model = ImuModel(gyroscope_sigma_rad_s=0.0, gyroscope_scale_sigma=2e-3)
    exact = ImuModel(gyroscope_sigma_rad_s=0.0)
    responses = []
    for seed in range(12):
        read, true = (
            imu_of(simulate_drive(scenario_of(imu=of), seed)).angular_velocity
            for of in (model, exact)
        )
        # The vehicle turns about its vertical alone.
        turning = np.abs(true[:, 2]) > 0.05
        assert turning.any()
        ratio = read[turning] / true[turning, 2:] - [0.0, 0.0, 1.0]
        np.testing.assert_allclose(ratio, np.tile(ratio[:1], (len(ratio), 1)), atol=1e-9)
        responses.append(ratio[0])
    assert np.sqrt(np.mean(np.square(responses))) == pytest.approx(2e-3, rel=0.5)


def test_bias_is_drawn_at_the_start_and_walks() -> None:
    imu = ImuModel(
        accelerometer_bias_sigma_m_s2=(0.1, 0.2, 0.4),
        gyroscope_bias_sigma_rad_s=0.01,
        accelerometer_bias_walk_m_s3_sqrthz=0.03,
        gyroscope_bias_walk_rad_s2_sqrthz=0.002,
    )
    firsts, steps = [], []
    for seed in range(60):
        simulated = simulate_drive(scenario_of(imu=imu), seed).imu
        assert simulated is not None
        both = np.hstack([simulated.accelerometer_bias, simulated.gyroscope_bias])
        firsts.append(both[0])
        steps.append(both[-1] - both[0])
    n = len(firsts)
    sigma = np.array([0.1, 0.2, 0.4, 0.01, 0.01, 0.01])
    walked = math.sqrt(17.0) * np.repeat([0.03, 0.002], 3)
    for drawn, expected in ((firsts, sigma), (steps, walked)):
        ratio = np.sqrt(np.mean(np.array(drawn) ** 2, axis=0)) / expected
        assert (np.abs(ratio - 1.0) < 4.0 / math.sqrt(2.0 * n)).all()
    # It is in what the IMU says.
    biased, plain = (
        imu_of(simulate_drive(scenario_of(imu=model), 5)) for model in (imu, ImuModel())
    )
    simulated = simulate_drive(scenario_of(imu=imu), 5).imu
    assert simulated is not None
    np.testing.assert_allclose(
        biased.specific_force - plain.specific_force, simulated.accelerometer_bias, atol=1e-12
    )


def test_yaw_bias_turns_what_is_said_to_the_left() -> None:
    imu = ImuModel(mounting=MOUNTED, orientation=OrientationModel(sigma_rad=0.0, yaw_bias_deg=2.0))
    said, true = (
        imu_of(simulate_drive(scenario_of("ramp", imu=model), 0)).orientation_xyzw
        for model in (imu, quiet_imu(mounting=MOUNTED))
    )
    assert said is not None
    assert true is not None
    error = Rotation.from_quat(said) * Rotation.from_quat(true).inv()
    expected = np.tile([0.0, 0.0, math.radians(2.0)], (len(said), 1))
    np.testing.assert_allclose(error.as_rotvec(), expected, atol=1e-12)


def test_gnss_is_where_the_antenna_is() -> None:
    gnss = GnssModel(lever_arm=(-0.8, 0.3, 1.6), horizontal_sigma_m=0.0, vertical_sigma_m=0.0)
    recording = simulate_drive(scenario_of("ramp", gnss=gnss), 0)
    states = recording.truth.states(gnss_of(recording).stamps_ns)
    arm = np.array([-0.8, 0.3, 1.6])
    expected = np.array(
        [R @ arm + p for R, p in zip(states.R_map_vehicle, states.position_map, strict=True)]
    )
    np.testing.assert_allclose(enu_of(recording), expected, atol=1e-6)
    # The vehicle frame is 0.4 m up, as the ground is, but for the height of this vehicle.
    assert expected[0, 2] == pytest.approx(0.4 + 1.6, abs=0.03)


def test_outages_jumps_and_outliers() -> None:
    base = GnssModel(phase_s=0.03)
    hit = GnssModel(
        phase_s=0.03,
        outages=(OutageModel(start_s=4.0, duration_s=2.0),),
        jumps=(JumpModel(start_s=9.0, duration_s=1.0, offset_enu_m=(3.0, -1.0, 0.5)),),
        outlier_probability=0.1,
        outlier_sigma_m=5.0,
    )
    clean, spoilt = (simulate_drive(scenario_of(gnss=model), 1) for model in (base, hit))
    begin_ns = spoilt.truth.start_ns
    gone = set(gnss_of(clean).stamps_ns.tolist()) - set(gnss_of(spoilt).stamps_ns.tolist())
    assert sorted((stamp - begin_ns) / 1e9 for stamp in gone) == pytest.approx(
        [4.03 + 0.1 * k for k in range(20)]
    )
    assert spoilt.gnss is not None
    assert set(spoilt.gnss.lost_ns.tolist()) == gone
    kept = np.isin(gnss_of(clean).stamps_ns, gnss_of(spoilt).stamps_ns)
    error = enu_of(spoilt) - enu_of(clean)[kept]
    time_s = (gnss_of(spoilt).stamps_ns - begin_ns) / 1e9
    jumped = (time_s >= 9.0) & (time_s < 10.0)
    np.testing.assert_allclose(np.median(error[jumped], axis=0), [3.0, -1.0, 0.5], atol=1e-6)
    off = np.linalg.norm(error[~jumped], axis=1) > 1e-6
    assert 5 <= off.sum() <= 30
    assert 2.0 < error[~jumped][off].std() < 8.0


def test_velocity_is_along_the_vehicle() -> None:
    recording = simulate_drive(scenario_of("arc", velocity=VelocityModel(sigma_m_s=0.0)), 0)
    velocity = twist_of(recording).velocity
    np.testing.assert_allclose(velocity[100], [2.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(velocity[0], 0.0)


def test_a_sensor_that_is_not_there_says_nothing() -> None:
    motion = simulate_drive(
        scenario_of(
            imu=ImuModel(enabled=False),
            gnss=GnssModel(enabled=False),
            velocity=VelocityModel(enabled=False),
        ),
        0,
    ).motion()
    assert (motion.poses, motion.imu, motion.gnss, motion.twist) == (None, None, None, None)
    bare = ImuModel(orientation=OrientationModel(enabled=False))
    imu = imu_of(simulate_drive(scenario_of(imu=bare), 0))
    assert imu.orientation_xyzw is None
    assert imu.orientation_cov is None


def test_each_sensor_has_draws_of_its_own() -> None:
    base = simulate_drive(scenario_of(), 4).motion()
    other = simulate_drive(
        scenario_of(gnss=GnssModel(enabled=False), imu=ImuModel(accelerometer_sigma_m_s2=1.0)), 4
    ).motion()
    assert base.imu is not None
    assert other.imu is not None
    assert base.twist is not None
    assert other.twist is not None
    np.testing.assert_array_equal(base.twist.velocity, other.twist.velocity)
    np.testing.assert_array_equal(base.imu.angular_velocity, other.imu.angular_velocity)
    again = simulate_drive(scenario_of(), 4).motion()
    assert again.imu is not None
    np.testing.assert_array_equal(base.imu.specific_force, again.imu.specific_force)
    assert not np.array_equal(
        base.imu.specific_force, imu_of(simulate_drive(scenario_of(), 5)).specific_force
    )


def test_sample_stamps_cover_the_drive_and_no_more() -> None:
    def milliseconds(*arguments: float) -> list[int]:
        return [int(stamp) // 10**6 for stamp in sample_stamps("imu", *arguments)]

    assert milliseconds(10.0, 0.0, 0.3) == [0, 100, 200, 300]
    assert milliseconds(10.0, 0.05, 0.3) == [50, 150, 250]
    assert milliseconds(10.0, 0.0, 0.3, 0.1) == [0, 100, 200]
    # Thirds of a second do not drift.
    assert sample_stamps("imu", 30.0, 0.0, 100.0)[-1] == 100_000_000_000


@pytest.mark.parametrize("what", ["imu", "gnss", "velocity", "lidars.front"])
def test_drive_that_ends_before_the_first_sample(what: str) -> None:
    late: dict[str, Any] = {
        "imu": {"imu": ImuModel(phase_s=20.0)},
        "gnss": {"gnss": GnssModel(phase_s=20.0)},
        "velocity": {"velocity": VelocityModel(phase_s=20.0)},
        "lidars.front": {},
    }
    scenario = scenario_of(**late[what])
    if what == "lidars.front":
        front = scenario.lidars["front"].model_copy(update={"phase_s": 20.0})
        scenario = scenario.model_copy(update={"lidars": {"front": front}})
    recording = simulate_drive(scenario, 0)
    with pytest.raises(ConfigError, match=rf"{what}: the drive of 17 s ends before the first"):
        recording.scan_stamps_ns("front") if what == "lidars.front" else recording.motion()


def test_gnss_without_a_single_fix() -> None:
    gnss = GnssModel(outages=(OutageModel(start_s=0.0, duration_s=99.0),))
    recording = simulate_drive(scenario_of(gnss=gnss), 0)
    assert len(gnss_of(recording).stamps_ns) == 0
    assert recording.gnss is not None
    assert len(recording.gnss.lost_ns) == 171


def test_seed_below_zero() -> None:
    with pytest.raises(ConfigError, match="seed"):
        simulate_drive(scenario_of(), -1)
