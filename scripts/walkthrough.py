"""From a bag to a localiser; run it in the folder of the checkout. `# %%` are cells."""

# %% A drive: your bag in out/walkthrough/drive, or a simulated one, 18 MB
from pathlib import Path

import gtsam
import numpy as np

from caliv_graph.common.progress import PlainProgress
from caliv_graph.config.load import load_config
from caliv_graph.fusion.factors import lidar_pose_factor
from caliv_graph.fusion.priors import extrinsic_values, lettered_keys, prior_factors
from caliv_graph.pipeline import calibrate
from caliv_graph.readers import open_recording
from caliv_graph.scenario.model import load_scenario
from caliv_graph.simulation.simulate import write_drive
from caliv_graph.uncertainty.pairs import sigmas_s2s
from caliv_graph.workflows.draft import draft_config

folder = Path("out/walkthrough")
if not (folder / "drive").exists():
    write_drive(load_scenario(Path("configs/scenarios/demo_arc.yaml")), folder, 1, output="bag")

# %% A config: what the bag does not tell is listed. Here it is the height above the ground
if not (config_file := folder / "my_config.yaml").exists():
    draft = draft_config(folder / "drive", config_file)
    config_file.write_text(draft.text.replace("# vehicle_height:", "vehicle_height:"))
config = load_config(config_file)

# %% The calibration, and what the drive determined
run = calibrate([open_recording(config)], config, PlainProgress(print))
result = run.calibration
for name, lidar in result.lidars.items():
    print(name, lidar.T_vehicle_lidar.translation(), dict(lidar.determined))
for direction in result.undetermined:
    print("not determined:", direction.text, "- remedy:", direction.remedy)
print("front to rear, 1 sigma:", sigmas_s2s(result, *list(result.lidars)[:2]))  # rad, m

# %% A localiser: extrinsics as variables under one joint prior; the target is its map
key = lettered_keys(result, "m")
graph, values = prior_factors(result, key), extrinsic_values(result, key)
odometry = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([1e-3, 5e-3], 3))  # rad, m, per scan
cov_at_map = np.diag(np.repeat([5e-3, 5e-3], 3) ** 2)  # of a registration, about the target
assert run.record is not None
target, before = run.solution.registrations[0], None
scans = zip(target.observation.clouds, target.T_target_lidar, strict=True)
for i, (cloud, T_map_lidar) in enumerate(sorted(scans, key=lambda scan: scan[0].stamp_ns)):
    last = gtsam.symbol("x", i)  # T_map_vehicle
    values.insert(last, T_map_lidar * result.lidars[cloud.lidar].T_vehicle_lidar.inverse())
    turned = T_map_lidar.inverse().AdjointMap()  # the factor takes it about the LiDAR
    noise = gtsam.noiseModel.Gaussian.Covariance(turned @ cov_at_map @ turned.T)
    graph.add(lidar_pose_factor(last, key(cloud.lidar), T_map_lidar, noise))
    (R,), (t,) = run.record.trajectories[0].poses_at([cloud.stamp_ns])
    now = gtsam.Pose3(gtsam.Rot3(R), t)
    if before is not None:
        graph.add(gtsam.BetweenFactorPose3(last - 1, last, before.between(now), odometry))
    before = now
solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
cov = gtsam.Marginals(graph, solved).marginalCovariance(last)
print("last pose in the map, 1 sigma:", np.sqrt(np.diag(cov)))  # rad, m, vehicle axes
