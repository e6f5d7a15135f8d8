"""Small pictures: a pair in, a PNG of its scan 0 as a pair's page first shows it out."""

from io import BytesIO

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from augkitti.draw import CAR_COLOURS
from augkitti.frames import F64, Array, box_pose, transform_points
from augkitti.raycast import box_corners
from augkitti.scan_pair import AugmentedPair
from augkitti.viewer.pair_data import first_camera

SIZE = (480, 300)
_FINER = 2  # drawn this much larger, then made smaller
_BACKGROUND = (15, 20, 27)
_NEAR_M = 0.5
_FIELD_RAD = 0.9  # of view, from top to bottom; as in `static/scene.js`
_COLOURS = 96
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]


def thumbnail(pair: AugmentedPair) -> bytes:
    """PNG bytes; the same pair gives the same."""
    width, height = SIZE[0] * _FINER, SIZE[1] * _FINER
    xyz = pair.scan0.xyz.astype(np.float64)
    rank = {row: n for n, row in enumerate(_virtual_rows(pair))}
    shade = np.clip((xyz[:, 2] + 2.0) / 5.0, 0.0, 1.0)
    colour = np.stack([96 + 120 * shade, 112 + 122 * shade, 132 + 118 * shade], axis=1).astype(np.uint8)
    big = np.zeros(len(xyz), dtype=bool)
    for row, number in rank.items():
        mine = pair.scan0.instance == row
        colour[mine] = _rgb(CAR_COLOURS[number % len(CAR_COLOURS)])
        big |= mine
    place = _Camera(pair, width, height)
    u, v, depth = place.project(xyz)
    inside = np.flatnonzero((depth > _NEAR_M) & (u >= 0) & (u < width - 2) & (v >= 0) & (v < height - 2))
    order = inside[np.argsort(-depth[inside], kind="stable")]  # the nearest last, so that it stays
    picture = np.full((height, width, 3), _BACKGROUND, np.uint8)
    column, line = u[order].astype(np.int64), v[order].astype(np.int64)
    wide = (depth[order] < 30.0) | big[order]
    for right, down, which in ((0, 0, slice(None)), (1, 0, wide), (0, 1, wide), (1, 1, big[order])):
        picture[line[which] + down, column[which] + right] = colour[order][which]
    image = Image.fromarray(picture)
    pen = ImageDraw.Draw(image)
    for row, number in rank.items():
        box = pair.objects[row].box0
        if box is not None:
            _draw_box(pen, place, box, _rgb(CAR_COLOURS[number % len(CAR_COLOURS)]))
    small = image.resize(SIZE, Image.Resampling.BOX).quantize(_COLOURS, dither=Image.Dither.NONE)
    out = BytesIO()
    small.save(out, "PNG", optimize=True)
    return out.getvalue()


def _virtual_rows(pair: AugmentedPair) -> list[int]:
    return [row for row, item in enumerate(pair.objects) if item.origin == "virtual"]


def _rgb(text: str) -> tuple[int, int, int]:
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)


class _Camera:
    """The page's first view as a projection to pixels."""

    def __init__(self, pair: AugmentedPair, width: int, height: int) -> None:
        view = first_camera(pair)
        bearing, rise = view["bearing"], view["rise"]
        back = np.array([np.cos(bearing) * np.cos(rise), np.sin(bearing) * np.cos(rise), np.sin(rise)])
        self.eye = np.array(view["target"]) + view["distance"] * back
        right = np.array([-np.sin(bearing), np.cos(bearing), 0.0])
        self.axes = np.stack([right, np.cross(back, right), -back])
        self.scale = height / 2.0 / np.tan(_FIELD_RAD / 2.0)
        self.middle = (width / 2.0, height / 2.0)

    def project(self, xyz: Array) -> tuple[F64, F64, F64]:
        """Column, line and depth (N,) of points (N, 3)."""
        off = np.asarray(xyz, dtype=np.float64) - self.eye
        x, y, z = ((off * axis).sum(axis=1) for axis in self.axes)
        deep = np.maximum(z, 1e-3)
        return self.middle[0] + self.scale * x / deep, self.middle[1] - self.scale * y / deep, z


def _draw_box(pen: ImageDraw.ImageDraw, camera: _Camera, box: npt.NDArray[np.float64], colour: tuple[int, ...]) -> None:
    u, v, depth = camera.project(transform_points(box_pose(box), box_corners(np.asarray(box[3:6]))))
    if (depth > _NEAR_M).all():
        for a, b in _EDGES:
            pen.line([(float(u[a]), float(v[a])), (float(u[b]), float(v[b]))], fill=colour, width=_FINER)
