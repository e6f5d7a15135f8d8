"""Settings of a network that a processor trains in milliseconds, and batches of random points for it."""

import numpy as np

from augkitti.frames import pose_from_xyz_yaw, transform_points
from training.config import GridConfig, LossConfig, NetworkConfig, Settings, TrainConfig
from training.sample import Sample

EGO = pose_from_xyz_yaw(-0.8, 0.05, 0.0, 0.02)
CAR = pose_from_xyz_yaw(0.4, -0.1, 0.0, -0.05)


def tiny_settings(**train: object) -> Settings:
    """16 x 12 x 8 voxels of 0.8 m, a few channels."""
    return Settings(
        grid=GridConfig(x_m=(0.0, 12.8), y_m=(-4.8, 4.8), z_m=(-3.0, 1.0), voxel_m=(0.8, 0.8, 0.5), max_points=5),
        network=NetworkConfig(
            vfe=(8, 12),
            middle=(6, 5, 4),
            blocks=((8, 2), (10, 2), (12, 1)),
            upsampled=6,
            upsampled_flow=7,
            rigid=(8, 4),
            ego=(8, 1),
        ),
        loss=LossConfig.model_validate({}),
        train=TrainConfig.model_validate({"batch": 2, "learning_rate": 3e-3, **train}),
    )


def tiny_sample(seed: int = 0, points: int = 300, settings: Settings | None = None) -> Sample:
    """Random points, a sixth of them on a car that moves; flow as the motions say."""
    grid = (settings or tiny_settings()).grid
    rng = np.random.default_rng(seed)
    low, high = (np.array(side) for side in zip(grid.x_m, grid.y_m, grid.z_m, strict=True))
    box = np.array([rng.uniform(3, 9), rng.uniform(-3, 3), -1.0, 3.9, 1.6, 1.5, 0.0])
    on_car = points // 6
    xyz = np.concatenate(
        [rng.uniform(low, high, (points - on_car, 3)), box[:3] + rng.uniform(-0.5, 0.5, (on_car, 3)) * box[3:6]]
    ).astype(np.float32)
    instance = np.concatenate([np.full(points - on_car, -1), np.zeros(on_car, int)])
    motion = np.stack([CAR, EGO])
    moved = transform_points(motion[instance], xyz.astype(np.float64))
    return Sample(
        pair_id=f"tiny/{seed}/0",
        xyz0=xyz,
        reflectance0=np.full(points, 0.3, np.float32),
        xyz1=moved.astype(np.float32),
        reflectance1=np.full(points, 0.3, np.float32),
        flow0=(moved - xyz).astype(np.float32),
        status0=np.zeros(points, bool),
        instance0=instance,
        instance1=instance,
        ego_motion=EGO,
        boxes0=box[None],
        category=("Car",),
        motion=CAR[None],
        has_motion=np.ones(1, bool),
        virtual=np.ones(1, bool),
        points0=np.array([on_car]),
        label_coverage="full",
        label_azimuth=None,
    )
