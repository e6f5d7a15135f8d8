"""The scanner's profile from raw scans alone: a made scanner is found again, and what cannot be known is said."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from augkitti import fit_sensor as fs
from augkitti import scanner
from augkitti.errors import InputError
from augkitti.fit_sensor import SourceScan, fit_beams, fitted_profile, gather, profile_content, table_profile
from augkitti.scan_pair import Scan
from augkitti.sensor_noise import noise_model

BEAMS, TICKS, PERIOD_S, FIRING_S = 16, 3600, 0.1, 5.17e-5
STEP = 2 * np.pi / TICKS
SPEED_MPS = 11.0
BLIND = {14: [(100, 180)], 15: [(90, 200), (3500, 3590)]}


def made_scanner() -> scanner.ScannerProfile:
    rng = np.random.default_rng(5)
    total = np.tile([-60.0, -20.0, 25.0, 61.0], 4) + rng.uniform(-3, 3, BEAMS)  # ticks
    total -= np.rint((total.max() + total.min()) / 2)
    offset = np.rint(total)
    content = {
        "name": "made",
        "version": 1,
        "source": "made",
        "lattice_size": TICKS,
        "seam_tick": TICKS // 2,
        "firing_period_s": FIRING_S,
        "range_quantum_m": 0.005,
        "coordinate_quantum_m": 0.001,
        "reflectance_quantum": 0.02,
        "min_range_m": 1.0,
        "max_range_m": 80.0,
        "shadow_first_ring": 14,
        "elevation_rad": np.radians(np.linspace(6.0, -22.0, BEAMS) + rng.uniform(-0.3, 0.3, BEAMS)).tolist(),
        "height_m": np.linspace(0.15, 0.08, BEAMS).tolist(),
        "side_m": (0.04 * (-1.0) ** np.arange(BEAMS) + rng.uniform(-0.005, 0.005, BEAMS)).tolist(),
        "azimuth_rad": ((total - offset) * STEP).tolist(),
        "tick_offset": offset.astype(int).tolist(),
        "range_phase_mm": rng.uniform(-2.4, 2.4, BEAMS).tolist(),
        "range_bias_mm": [0] * BEAMS,
        "never_returned_ticks": [[list(run) for run in BLIND.get(beam, [])] for beam in range(BEAMS)],
    }
    return scanner.profile_from_content(content, "made")


MADE = made_scanner()


@dataclass(frozen=True)
class Place:
    """Walls by their normal's azimuth and distance, and ground that rises along x and y.

    On level ground a low beam always meets it at the same range, and no fit tells its elevation from its height.
    """

    walls: tuple[tuple[float, float], ...]
    rise: tuple[float, float]


HALL = Place(((0.3, 19.0), (1.7, 9.0), (2.9, 37.0), (3.5, 24.0), (4.6, 13.0), (5.5, 11.0)), (0.12, -0.08))
YARD = Place(((0.1, 26.0), (1.2, 14.0), (2.4, 15.0), (3.3, 17.0), (4.4, 7.0), (5.3, 31.0)), (-0.06, 0.1))


def made_scan(place: Place, drive: str, frame: int, clockwise: bool = True, speed_mps: float = SPEED_MPS) -> SourceScan:
    """One revolution of the made scanner in a place of walls and ground, moving ahead while it turns."""
    rng = np.random.default_rng([frame, len(drive), clockwise])
    period_s = PERIOD_S * rng.uniform(0.995, 1.005)  # no motor turns evenly: steps and firings are in no fixed ratio
    step = TICKS * FIRING_S / period_s
    order = np.floor(np.arange(rng.uniform(0, step), TICKS, step)).astype(int)
    tick = (TICKS // 2 - 1 - order) % TICKS if clockwise else (TICKS // 2 + order) % TICKS
    time_s = np.tile((order / TICKS + frame) * PERIOD_S, BEAMS)
    ring = np.repeat(np.arange(BEAMS, dtype=np.uint8), len(tick))
    tick = np.tile(tick, BEAMS).astype(np.uint16)
    azimuth = scanner.tick_azimuth(MADE, ring, tick)
    origin, direction = scanner.ray_lines(MADE, ring, azimuth, MADE.elevation_rad[ring])
    normal = np.array([place.rise[0], place.rise[1], -1.0])  # into the ground
    falls = direction @ normal
    reach = np.where(falls > 1e-9, (1.7 - origin @ normal) / np.maximum(falls, 1e-9), np.inf)
    for heading, away in place.walls:
        normal = np.array([np.cos(heading), np.sin(heading), 0.0])
        falls = direction @ normal
        wall = (away - speed_mps * time_s * normal[0] - origin @ normal) / np.where(falls > 1e-9, falls, np.inf)
        reach = np.minimum(reach, np.where(falls > 1e-9, wall, np.inf))
    reach = reach + rng.normal(0.0, 0.008, len(reach))
    quantum, phase = MADE.range_quantum_m, MADE.range_phase_m[ring]
    reach = np.rint((reach - phase) / quantum) * quantum + phase
    keep = (reach > 1.0) & (reach < 80.0) & (rng.random(len(reach)) > 0.03) & ~MADE.blind[ring, tick]
    exact = (origin + reach[:, None] * direction)[keep]
    xyz = np.rint(exact * 1e3) / 1e3
    # The wrap trap: now and then a point stands on the wrong side of it.
    turn = (np.arctan2(exact[:, 1], exact[:, 0]) + rng.normal(0.0, 3e-4, len(exact))) % (2 * np.pi)
    rows = np.lexsort((turn, ring[keep]))
    n = len(rows)
    shine = (rng.integers(0, 50, n) * 0.02).astype(np.float32)
    scan = Scan(xyz[rows].astype(np.float32), shine, np.arange(n, dtype=np.int32), n, "raw", frame * PERIOD_S, period_s)
    return SourceScan(scan, drive, frame, True)


def made_drive(place: Place, drive: str, scans: int, **options) -> list[SourceScan]:
    return [made_scan(place, drive, frame, **options) for frame in range(scans)]


@pytest.fixture(scope="module")
def scans() -> list[SourceScan]:
    return made_drive(HALL, "hall", 11) + made_drive(YARD, "yard", 11)


@pytest.fixture(scope="module")
def table(scans) -> fs.BeamTable:
    return fit_beams(scans)


@pytest.fixture(scope="module")
def fitted(scans, table) -> scanner.ScannerProfile:
    return fitted_profile(profile_content(table, gather(table, scans), "found"))


def test_beam_table_of_a_made_scanner_is_found_from_its_scans(table):
    assert table.lattice_size == TICKS
    np.testing.assert_allclose(np.degrees(table.elevation_rad - MADE.elevation_rad), 0.0, atol=0.002)
    np.testing.assert_allclose(table.height_m, MADE.height_m, atol=0.5e-3)
    np.testing.assert_allclose(table.side_m, MADE.side_m, atol=0.5e-3)
    np.testing.assert_allclose(np.degrees(table.azimuth_rad - MADE.azimuth_rad), 0.0, atol=0.002)
    np.testing.assert_array_equal(table.tick_offset, MADE.tick_offset)


def test_steps_of_range_coordinates_and_reflectance_are_found(fitted):
    assert fitted.range_quantum_m == pytest.approx(0.005)
    assert fitted.coordinate_quantum_m == pytest.approx(0.001)
    assert fitted.reflectance_quantum == pytest.approx(0.02)
    off = (fitted.range_phase_m - MADE.range_phase_m + 0.0025) % 0.005 - 0.0025
    np.testing.assert_allclose(off, 0.0, atol=1e-4)


def test_spin_seam_and_firing_period_are_found_from_a_drive_that_moves(fitted):
    assert fitted.content["spin"] == "clockwise"
    assert fitted.seam_tick == TICKS // 2
    assert fitted.content["fit"]["seam_measured_at"] == pytest.approx(TICKS // 2, abs=2)
    assert fitted.firing_period_s == pytest.approx(FIRING_S, rel=2e-3)


def test_rays_that_never_return_are_found_and_no_others(fitted):
    assert fitted.shadow_first_ring == 14
    missed = MADE.blind & ~fitted.blind
    assert not (fitted.blind & ~MADE.blind).any()
    for ring, tick in zip(*np.nonzero(missed), strict=True):  # a lower bound: edges only
        assert min(min(abs(tick - a), abs(tick - b)) for a, b in BLIND[ring]) <= 5


def test_points_lie_on_the_fitted_rays(scans, fitted):
    for source in (made_scan(HALL, "hall", 12), made_scan(YARD, "yard", 12)):  # not fitted on
        rays = scanner.assign_rays(source.scan, fitted)
        assert np.mean(rays.tick != scanner.NO_TICK) > 0.9999
        assert np.median(scanner.ray_distance(source.scan, rays, fitted)) <= 0.5e-3


def test_counter_clockwise_scanner_is_told_from_a_clockwise_one(table):
    turned = made_drive(HALL, "hall", 6, clockwise=False)
    evidence = gather(table, turned)
    assert (evidence.seam.spin, evidence.seam.measured) == ("counter-clockwise", True)
    assert any("counter-clockwise" in text for text in fs.cannot_tell(table, evidence))


def test_spin_is_said_to_be_assumed_where_the_scanner_stands(table):
    evidence = gather(table, made_drive(HALL, "hall", 6, speed_mps=0.0))
    assert not evidence.seam.measured
    assert any("assumed" in text for text in fs.cannot_tell(table, evidence))
    assert "(assumed)" in profile_content(table, evidence, "found")["spin"]


def test_one_drive_gives_a_beam_table_and_says_what_it_cannot_give(scans):
    drive = [source for source in scans if source.drive == "hall"]
    table = fit_beams(drive)
    np.testing.assert_allclose(np.degrees(table.elevation_rad - MADE.elevation_rad), 0.0, atol=0.004)
    content = profile_content(table, gather(table, drive), "found")
    said = " ".join(content["fit"]["cannot_tell"])
    assert all(words in said for words in ("never return", "two drives", "held out"))
    assert not fitted_profile(content).blind.any()


def test_compensated_scans_are_refused_with_the_remedy(scans):
    moved = [replace(source, scan=replace(source.scan, kind="compensated")) for source in scans[:3]]
    with pytest.raises(InputError, match=r"never mixed.*give raw drives"):
        fit_beams([*scans[3:], *moved])


def test_compensated_scans_under_the_name_of_raw_ones_are_refused(scans):
    with pytest.raises(InputError, match=r"no encoder steps.*compensated.*give raw drives"):
        fit_beams([compensated(source) for source in scans[:6]])


def compensated(source: SourceScan) -> SourceScan:
    """Points moved to where the scanner was at the scan's middle, as odometry scans are, still called raw."""
    xyz = source.scan.xyz.astype(np.float64)
    turn = np.arctan2(xyz[:, 1], xyz[:, 0])
    xyz[:, 0] -= SPEED_MPS * PERIOD_S * turn / (2 * np.pi)
    return replace(source, scan=replace(source.scan, xyz=xyz.astype(np.float32)))


def test_scan_off_the_rays_is_left_out_and_named(scans, table):
    evidence = gather(table, [*scans[:3], compensated(scans[5]), scans[7]])
    assert [place[:2] for place in evidence.left_out] == [("hall", 5)]
    assert sum(evidence.scans.values()) == 4


def test_too_few_scans_are_refused(scans):
    with pytest.raises(InputError, match="2 raw scans; a beam table needs 3"):
        fit_beams(scans[:2])


def test_scans_with_rings_cut_off_do_not_shift_the_others(scans, table):
    rings = scanner.assign_rays(scans[0].scan, MADE).ring
    keep = (rings >= 2) & (rings < 14)
    cut = replace(scans[0], scan=replace(scans[0].scan, **{k: getattr(scans[0].scan, k)[keep] for k in FIELDS}))
    again = fit_beams([cut, *scans[1:]])
    np.testing.assert_allclose(again.elevation_rad, table.elevation_rad, atol=1e-5)
    assert not gather(table, [cut]).left_out


FIELDS = ("xyz", "reflectance", "row")


def test_points_out_of_ring_order_are_refused(scans):
    rng = np.random.default_rng(0)
    mixed = []
    for source in scans[:4]:
        order = rng.permutation(len(source.scan))
        mixed.append(replace(source, scan=replace(source.scan, xyz=source.scan.xyz[order])))
    with pytest.raises(InputError, match="rings cannot be told apart"):
        fit_beams(mixed)


def write_root(root: Path, scans: list[SourceScan]) -> None:
    for source in scans:
        stamps = root / "raw" / "2011_09_26" / f"2011_09_26_drive_{source.drive}_sync" / "velodyne_points"
        (stamps / "data").mkdir(parents=True, exist_ok=True)
        rows = np.column_stack([source.scan.xyz, source.scan.reflectance]).astype(np.float32)
        rows.tofile(stamps / "data" / f"{source.frame:010d}.bin")
        for part, at in (("", 0.5), ("_start", 0.0), ("_end", 1.0)):
            with open(stamps / f"timestamps{part}.txt", "a", encoding="utf-8") as file:
                file.write(f"2011-09-26 13:02:{25 + source.frame * PERIOD_S + at * source.scan.period_s:012.9f}\n")


def test_command_writes_a_folder_that_loads_as_a_profile(tmp_path, scans):
    from pipelines.fit_sensor import fit_sensor

    write_root(tmp_path / "kitti", [replace(s, drive={"hall": "0001", "yard": "0002"}[s.drive]) for s in scans])
    said: list[str] = []
    figures = fit_sensor(tmp_path / "kitti", tmp_path / "profile", tmp_path / "figures.json", said.append)
    profile = scanner.load_profile(tmp_path / "profile")
    np.testing.assert_array_equal(profile.tick_offset, MADE.tick_offset)
    assert profile.firing_period_s == pytest.approx(FIRING_S, rel=2e-3)
    assert (profile.range_bias_m == 0.0).all()
    assert json.loads((tmp_path / "figures.json").read_text()) == json.loads(json.dumps(figures))
    assert len(figures["held_out"]) == 0 or figures["held_out"][0]["median_mm"] <= 0.5
    card = (tmp_path / "profile" / "README.md").read_text()
    assert all(words in card for words in ("2011_09_26_drive_0001 | 11", "What it cannot know"))
    with pytest.raises(InputError, match="noise"):
        noise_model(profile)


def test_command_refuses_a_folder_with_learned_noise_and_a_root_of_compensated_scans(tmp_path, scans):
    from pipelines.fit_sensor import fit_sensor

    folder = tmp_path / "odometry" / "sequences" / "00" / "velodyne"
    folder.mkdir(parents=True)
    np.column_stack([scans[0].scan.xyz, scans[0].scan.reflectance]).tofile(folder / "000000.bin")
    with pytest.raises(InputError, match="all of its 1 scans are compensated"):
        fit_sensor(tmp_path, tmp_path / "profile")
    (tmp_path / "noisy").mkdir()
    (tmp_path / "noisy" / "profile.json").write_text('{"noise": {}}')
    with pytest.raises(InputError, match="with noise"):
        fit_sensor(tmp_path, tmp_path / "noisy")


@pytest.mark.kitti
def test_a_few_real_scans_give_the_shipped_beam_table(kitti_root: Path) -> None:
    from augkitti import kitti
    from pipelines.fit_sensor import raw_places, read

    places = raw_places(kitti.open_root(kitti_root))[::4]
    scans = [source for place in places if (source := read(place, {})) is not None]
    found, shipped = fit_beams(scans), scanner.load_profile()
    assert found.lattice_size == shipped.lattice_size
    np.testing.assert_allclose(np.degrees(found.elevation_rad - shipped.elevation_rad), 0.0, atol=0.002)
    np.testing.assert_allclose(found.height_m, shipped.height_m, atol=0.5e-3)
    np.testing.assert_allclose(found.side_m, shipped.side_m, atol=0.5e-3)
    step = shipped.tick_step_rad
    total = found.azimuth_rad - shipped.azimuth_rad + step * (found.tick_offset - shipped.tick_offset)
    np.testing.assert_allclose(np.degrees(total), 0.0, atol=0.002)
    rays = scanner.assign_rays(scans[1].scan, table_profile(found))
    assert np.median(scanner.ray_distance(scans[1].scan, rays, table_profile(found))) <= 0.5e-3
