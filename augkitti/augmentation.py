"""The story: a real scan pair and car models in, the same pair with virtual cars and exact labels out.

Read `augment_pair` first; each step is a file of its own.
"""

from collections.abc import Sequence

from augkitti.add_cars import (
    Cast,
    cast_and_measure,
    finish_pair,
    hides_what_is_behind,
    keeps_its_shape,
    occlude_both,
    seen_well_enough,
)
from augkitti.config import Config
from augkitti.drivable import find_drivable_region
from augkitti.ground import fit_ground, standing_points
from augkitti.labelled_objects import label_points
from augkitti.movers import unlabelled_movers
from augkitti.placement import make_scene, propose_car
from augkitti.scan_pair import AugmentedPair, CarModel, PreparedPair, PreparedScan, Scan, ScanPair, VirtualCar
from augkitti.scanner import ScannerProfile, assign_rays
from augkitti.seeds import generator


def prepare_scan(scan: Scan, profile: ScannerProfile, config: Config) -> PreparedScan:
    """All that depends on one scan alone: its rays, the ground, and where a car may stand."""
    rays = assign_rays(scan, profile)
    ground = fit_ground(scan.xyz, config.ground)
    region = find_drivable_region(scan, rays, ground, config.drivable)
    return PreparedScan(scan, rays, ground, region, standing_points(scan.xyz, ground))


def prepare_pair(pair: ScanPair, scan0: PreparedScan, scan1: PreparedScan, config: Config) -> PreparedPair:
    """All that depends on a pair's source alone: both prepared scans, whose their points are, what moves unlabelled."""
    labelled = label_points(pair, scan0, scan1)
    return PreparedPair(scan0, scan1, labelled, unlabelled_movers(pair, scan0, scan1, config.movers))


def augment_pair(
    pair: ScanPair,
    models: Sequence[CarModel],
    profile: ScannerProfile,
    config: Config,
    seed: int,
    pair_id: str,
    prepared: PreparedPair | None = None,
) -> AugmentedPair | None:
    """Put virtual cars into a pair (PointFlowNet section 4.1); None where fewer than `config.cars` found room.

    Args:
        pair: two neighbouring scans with ego-motion and labels.
        models: the cars to draw from.
        profile: the scanner that took the scans.
        config: how many cars, where, how they move and how they are cast.
        seed: of this pair alone; the same seed gives the same bytes.
        pair_id: the contract's name of the pair.
        prepared: the pair as `prepare_pair` gives it, if at hand.
    """
    prepared = prepared or prepare_pair(
        pair, prepare_scan(pair.scan0, profile, config), prepare_scan(pair.scan1, profile, config), config
    )
    scan0, scan1 = prepared.scan0, prepared.scan1
    scene = make_scene(pair, scan0, scan1, config)
    fewest, most = config.cars
    rng = generator(seed, "place")
    wanted = int(rng.integers(fewest, most + 1))

    cars: list[VirtualCar] = []
    casts: list[Cast] = []
    occluded = occlude_both(casts, scan0, scan1, profile)
    for attempt in range(config.placement.attempts):
        if len(cars) == wanted:
            break
        car = propose_car(scene, cars, models, not cars, occluded, config, rng)  # place and motion
        if car is None:
            continue
        cast = cast_and_measure(car, pair, scan0, scan1, profile, config, generator(seed, "look", attempt))
        if not keeps_its_shape(car, cast, scan0, scan1, profile):
            continue
        if not hides_what_is_behind(car, cast, scan0, scan1, profile):
            continue
        together = occlude_both([*casts, cast], scan0, scan1, profile)
        if seen_well_enough(together, len(casts) + 1, config.min_points):
            cars.append(car)
            casts.append(cast)
            occluded = together
    if len(cars) < fewest:
        return None
    return finish_pair(pair, prepared, cars, casts, occluded, seed, pair_id)
