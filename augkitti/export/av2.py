"""A pair in, a log of Argoverse 2's sensor data set with two sweeps out, and its scene flow labels, as feather files.

Sources of the form: the user guide of Argoverse 2 and PyPI's `bucketed-scene-flow-eval`, whose loader takes the folder
`<part>` and finds the labels in `<part>_sceneflow_feather` beside it. There flow is over ground, in the first sweep's
frame: where a point would be, seen from there, less where it is. The vehicle's frame is the scanner's, the city's is
the vehicle's in the first sweep.
"""

import json
from io import BytesIO
from typing import Any

import numpy as np

from augkitti.export.target import (
    Files,
    Format,
    Scene,
    firing_times,
    ground_of,
    nanoseconds,
    of_objects,
    scene_name,
)
from augkitti.frames import F32, F64, box_pose, invert, transform_points
from augkitti.scan_pair import AugmentedPair, AugmentedScan, GroundMap, ObjectRecord

CATEGORIES = (
    "ANIMAL", "ARTICULATED_BUS", "BICYCLE", "BICYCLIST", "BOLLARD", "BOX_TRUCK", "BUS", "CONSTRUCTION_BARREL",
    "CONSTRUCTION_CONE", "DOG", "LARGE_VEHICLE", "MESSAGE_BOARD_TRAILER", "MOBILE_PEDESTRIAN_CROSSING_SIGN",
    "MOTORCYCLE", "MOTORCYCLIST", "OFFICIAL_SIGNALER", "PEDESTRIAN", "RAILED_VEHICLE", "REGULAR_VEHICLE", "SCHOOL_BUS",
    "SIGN", "STOP_SIGN", "STROLLER", "TRAFFIC_LIGHT_TRAILER", "TRUCK", "TRUCK_CAB", "VEHICULAR_TRAILER", "WHEELCHAIR",
    "WHEELED_DEVICE", "WHEELED_RIDER",
)  # fmt: skip
BACKGROUND = -1
_OF_KITTI = {  # Misc is most often a trailer; any other name becomes background
    "Car": "REGULAR_VEHICLE",
    "Van": "REGULAR_VEHICLE",
    "Truck": "TRUCK",
    "Tram": "RAILED_VEHICLE",
    "Misc": "VEHICULAR_TRAILER",
    "Pedestrian": "PEDESTRIAN",
    "Person": "PEDESTRIAN",
    "Person_sitting": "PEDESTRIAN",
    "Person (sitting)": "PEDESTRIAN",
    "Cyclist": "BICYCLIST",
}


def category_index(kitti: str) -> int:
    """Place in `CATEGORIES` of one of KITTI's categories; -1, background, for a name that KITTI does not have."""
    return CATEGORIES.index(_OF_KITTI[kitti]) if kitti in _OF_KITTI else BACKGROUND


def log_files(pair: AugmentedPair, scene: Scene) -> Files:
    """Sweeps, poses, calibration, boxes, ground heights and flow labels of one pair, in folders of its log's name."""
    name, stamps = scene_name(pair), nanoseconds(pair)
    log = f"{scene.part}/{name}"
    ground = ground_of(pair.scan0, scene)[1]
    return {
        **{
            f"{log}/sensors/lidar/{stamp}.feather": _sweep(pair, scan, scene)
            for stamp, scan in zip(stamps, (pair.scan0, pair.scan1), strict=True)
        },
        f"{log}/city_SE3_egovehicle.feather": _feather(
            {"timestamp_ns": np.array(stamps), **_poses([np.eye(4), invert(pair.ego_motion)])}
        ),
        f"{log}/calibration/egovehicle_SE3_sensor.feather": _feather(
            {"sensor_name": ["up_lidar", "down_lidar"], **_poses([np.eye(4), np.eye(4)])}
        ),
        f"{log}/annotations.feather": _boxes(pair.objects, stamps),
        **_ground_files(f"{log}/map/{name}", ground),
        f"{scene.part}_sceneflow_feather/{name}/{stamps[0]}.feather": _flow(pair),
    }


def flow_over_ground(pair: AugmentedPair) -> F32:
    """Flow (N0, 3) without the ego-motion, in velo0: 0 for all that stands."""
    xyz = pair.scan0.xyz.astype(np.float64)
    return (transform_points(invert(pair.ego_motion), xyz + pair.flow0) - xyz).astype(np.float32)


def _flow(pair: AugmentedPair) -> bytes:
    flow = flow_over_ground(pair)
    classes = of_objects(pair.scan0, [category_index(item.category) for item in pair.objects], BACKGROUND)
    return _feather(
        {
            **{f"flow_t{axis}_m": flow[:, i] for i, axis in enumerate("xyz")},
            "is_valid": pair.flow_status0 == 0,
            "classes_0": classes.astype(np.int8),
        }
    )


def _sweep(pair: AugmentedPair, scan: AugmentedScan, scene: Scene) -> bytes:
    return _feather(
        {
            **{axis: np.ascontiguousarray(scan.xyz[:, i]) for i, axis in enumerate("xyz")},
            "intensity": np.rint(255.0 * scan.reflectance).astype(np.uint8),
            "laser_number": scan.ring,
            "offset_ns": np.rint(1e9 * firing_times(pair, scan, scene.profile)).astype(np.int32),
        }
    )


def _boxes(objects: tuple[ObjectRecord, ...], stamps: tuple[int, int]) -> bytes:
    """Boxes of both sweeps; a virtual car's is turned as its pose is, slope and all."""
    rows: list[tuple[int, str, str, F64, int]] = []
    poses = []
    for k, stamp in enumerate(stamps):
        for item in objects:
            box, pose = (item.box0, item.pose0) if k == 0 else (item.box1, item.pose1)
            place = category_index(item.category)
            if box is not None and place != BACKGROUND:
                count = item.points0 if k == 0 else item.points1
                rows.append((stamp, item.id, CATEGORIES[place], box[3:6], count))
                poses.append(box_pose(box) if pose is None else pose)
    sizes = np.array([row[3] for row in rows]).reshape(-1, 3)
    return _feather(
        {
            "timestamp_ns": np.array([row[0] for row in rows], np.int64),
            "track_uuid": _words([row[1] for row in rows]),
            "category": _words([row[2] for row in rows]),
            **{f"{name}_m": sizes[:, i] for i, name in enumerate(("length", "width", "height"))},
            **_poses(poses),
            "num_interior_pts": np.array([row[4] for row in rows], np.int64),
        }
    )


def _poses(poses: list[F64]) -> dict[str, F64]:
    """Columns of poses: quaternions, the scalar first, and places."""
    from scipy.spatial.transform import Rotation

    stack = np.array(poses).reshape(-1, 4, 4)
    quaternions = np.zeros((0, 4))
    if len(stack):
        quaternions = Rotation.from_matrix(stack[:, :3, :3]).as_quat(scalar_first=True)
    columns = {name: quaternions[:, i] for i, name in enumerate(("qw", "qx", "qy", "qz"))}
    return {**columns, **{f"t{axis}_m": stack[:, i, 3] for i, axis in enumerate("xyz")}}


def _ground_files(stem: str, ground: GroundMap) -> Files:
    """Ground heights under the first sweep: rows along y, columns along x, a cell's centre at whole numbers."""
    heights = BytesIO()
    np.save(heights, np.ascontiguousarray(ground.height_m.T))
    first = [-(corner + 0.5 * ground.cell_m) for corner in ground.origin_m]
    place = {"R": [1.0, 0.0, 0.0, 1.0], "t": first, "s": 1.0 / ground.cell_m}
    return {
        f"{stem}_ground_height_surface____CITY.npy": heights.getvalue(),
        f"{stem}___img_Sim2_city.json": json.dumps(place).encode(),
    }


def _words(values: list[str]) -> Any:
    import pyarrow as pa

    return pa.array(values, pa.string())


def _feather(columns: dict[str, Any]) -> bytes:
    import pyarrow as pa
    from pyarrow import feather

    content = BytesIO()
    arrays = {name: np.ascontiguousarray(v) if isinstance(v, np.ndarray) else v for name, v in columns.items()}
    feather.write_feather(pa.table(arrays), content)
    return content.getvalue()


AV2 = Format(
    name="av2",
    reader="Argoverse 2's tools and bucketed-scene-flow-eval",
    lost="ticks (offset_ns has the moments of firing), surfaces, source rows and removed points, CAD models, speeds "
    "and steering, each box's own moment, objects of categories that KITTI does not have; reflectance is kept to 1/255",
    files=log_files,
)
