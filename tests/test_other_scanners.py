"""Scanners other than KITTI's: a shipped profile of 32 beams, a user's file, and what is said of a bad one."""

import json
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import yaml

from augkitti import scanner
from augkitti.dataset import open_dataset
from augkitti.draw import range_image
from augkitti.errors import InputError
from augkitti.kitti import open_root, read_scan
from augkitti.scan_pair import MEASURED, Scan
from augkitti.sensor_noise import noise_model
from augkitti.validate_folder import validate_folder
from pipelines.generate import generate
from pipelines.run import read_options, reopen_run, start_work

TEXT = (resources.files("augkitti") / "profiles" / "hdl32e.yaml").read_text(encoding="utf-8")
PROFILE = scanner.load_profile("hdl32e")
KITTI = scanner.load_profile()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two pairs on the embedded street, and where its scans lie."""
    folder = tmp_path_factory.mktemp("hdl32e")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AUGKITTI_CACHE", str(folder / "cache"))
        options = read_options(
            kitti=None, cad=None, out=folder / "aug", n=2, seed=0, config=None, profile=Path("hdl32e"),
            stop_on_error=True,
        )  # fmt: skip
        assert generate(options, jobs=1, resume=False, dry_run=False) == 0
        return options


def file_with(tmp_path, **changes):
    path = tmp_path / "mine.yaml"
    path.write_text(json.dumps({**yaml.safe_load(TEXT), **changes}))
    return path


def test_the_shipped_scanner_of_32_beams_is_as_its_manual_says():
    degrees = np.degrees(PROFILE.elevation_rad)
    assert (PROFILE.beams, PROFILE.max_range_m, PROFILE.range_quantum_m) == (32, 100.0, 0.002)
    np.testing.assert_allclose(degrees, 32.0 / 3.0 - np.arange(32) * 4.0 / 3.0, atol=0.01)
    assert 2150 <= PROFILE.period_s / PROFILE.firing_period_s <= 2190
    delays = -PROFILE.azimuth_rad / (2.0 * np.pi) * PROFILE.period_s
    assert np.sort(delays) == pytest.approx(np.arange(32) * 1.152e-6, abs=2e-8)
    assert np.argmin(delays) == 31, "the lowest fires first"
    assert noise_model(PROFILE).body.paint(0.5) == noise_model(KITTI).body.paint(0.5)


def test_pairs_of_32_beams_keep_every_invariant(made):
    report = validate_folder(made.out, made.root, jobs=1)
    assert report.first == ()
    assert report.pairs == 2
    assert validate_folder(made.out, None, jobs=1).first == ()


def test_pairs_of_32_beams_look_like_their_scanner(made):
    pair = open_dataset(made.out)[0]
    assert pair.scan0.ring.max() == 31
    assert {item.origin for item in pair.objects} >= {"virtual"}
    simulated = pair.scan0.surface != MEASURED
    assert simulated.sum() >= 20
    steps = pair.scan0.reflectance[simulated] * 255.0
    assert np.abs(steps - np.rint(steps)).max() < 1e-3
    assert range_image(pair.scan0.xyz, pair.scan0.ring, beams=PROFILE.beams).shape[0] == 32


def test_points_of_the_street_find_their_beam_and_tick_again(made):
    sequence = open_root(made.root).sequences[0]
    scan = read_scan(sequence, sequence.frames[0], PROFILE.elevation_rad)
    assert scan.period_s == pytest.approx(0.1, abs=2e-4)
    rays = scanner.assign_rays(scan, PROFILE)
    assert np.median(scanner.ray_distance(scan, rays, PROFILE)) <= 0.5e-3
    assert set(rays.ring) == set(range(32))
    assert 2100 < len(np.unique(rays.ray_tick)) < 2200


def test_a_run_remembers_a_shipped_profile_by_its_name(made, tmp_path):
    options = replace(made, out=tmp_path / "other")
    from pipelines.run import open_run

    start_work(open_run(options), resume=False)
    assert json.loads((options.work / "run.json").read_text())["options"]["profile"] == "hdl32e"
    assert reopen_run(options.out).options.scanner.digest == PROFILE.digest


def test_a_file_may_say_one_number_for_all_beams_and_gives_the_same_profile_as_lists(tmp_path):
    lists = file_with(tmp_path, height_m=[0.2] * 32, tick_offset=[0] * 32)
    assert scanner.load_profile(lists).digest == PROFILE.digest
    content = tmp_path / "mine.json"
    content.write_text(json.dumps(PROFILE.content))
    assert scanner.load_profile(content).digest == PROFILE.digest
    assert isinstance(PROFILE.content["height_m"], list), "shards carry lists, whatever the file says"


def test_a_file_named_like_a_shipped_profile_is_reached_by_its_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("hdl32e").write_text("{}")
    assert scanner.load_profile(Path("hdl32e")).digest == PROFILE.digest
    with pytest.raises(InputError, match="missing"):
        scanner.load_profile(Path("hdl32e").absolute())


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("elevation_rad", [0.1, 0.2], "must fall"),
        ("elevation_rad", "steep", "elevation_rad"),
        ("height_m", [0.2] * 31, "needs 32 numbers"),
        ("tick_offset", ["a"] * 32, "tick_offset"),
        ("lattice_size", 36000, "take fewer ticks"),
        ("lattice_size", 4000.5, "whole number"),
        ("seam_tick", 4000, "from 0 to 3999"),
        ("period_s", -0.1, "above 0"),
        ("max_range_m", 0.5, "min_range_m"),
        ("range_quantum_m", None, "range_quantum_m"),
        ("never_returned_ticks", [[[0, 4000]]] * 32, "beam 0 leaves"),
        ("never_returned_ticks", 3, "needs 32 lists"),
        ("periods", 0.1, "did you mean `period_s`"),
        ("version", "one", "version"),
    ],
)
def test_a_bad_key_of_a_user_profile_is_named(tmp_path, key, value, told):
    with pytest.raises(InputError) as caught:
        scanner.load_profile(file_with(tmp_path, **{key: value}))
    assert f"`{key}`" in str(caught.value)
    assert told in str(caught.value)
    assert len(str(caught.value)) < 600


def test_a_missing_key_and_a_bad_key_of_the_noise_are_named(tmp_path):
    content = yaml.safe_load(TEXT)
    del content["firing_period_s"]
    (tmp_path / "short.yaml").write_text(json.dumps(content))
    with pytest.raises(InputError, match="`firing_period_s` is missing"):
        scanner.load_profile(tmp_path / "short.yaml")
    noise = content["noise"] | {"relief": {**content["noise"]["relief"], "most_m": 0.5}}
    with pytest.raises(InputError, match=r"`noise\.relief\.most_m`"):
        noise_model(scanner.load_profile(file_with(tmp_path, noise=noise)))


def test_a_name_that_is_no_file_lists_the_shipped_profiles():
    with pytest.raises(InputError, match="hdl32e, hdl64e_kitti"):
        scanner.load_profile(Path("hdl16"))


def test_every_key_of_the_template_has_a_comment_before_or_beside_it():
    lines = TEXT.split("\nnoise:\n")[0].splitlines()
    bare = [
        line.split(":")[0]
        for number, line in enumerate(lines)
        if line[:1].isalpha() and not any("#" in near for near in lines[max(0, number - 2) : number + 1])
    ]
    assert bare == []


def test_the_shipped_default_keeps_what_its_noise_was_learned_with():
    assert (KITTI.firings, KITTI.ring_step_rad, KITTI.reflectance_steps, KITTI.period_s) == (2150, 0.0075, 99, 0.1034)
    assert KITTI.digest.startswith("48497ed32111"), "its digest stands in every shard"


def test_a_scan_of_a_scanner_that_looks_down_less_is_not_taken_for_a_cut_one(tmp_path, made):
    sequence = open_root(made.root).sequences[0]
    path = sequence.scan_path(sequence.frames[0])
    rows = np.fromfile(path, "<f4").reshape(-1, 4)
    down = np.arctan2(rows[:, 2] - 0.2, np.hypot(rows[:, 0], rows[:, 1]))
    whole, flat = path.read_bytes(), rows[down > np.radians(-12.6)]
    try:
        path.write_bytes(flat.tobytes())
        with pytest.raises(InputError, match="cut short"):
            read_scan(sequence, sequence.frames[0], PROFILE.elevation_rad)
        sixteen = np.radians(np.linspace(15.0, -15.0, 16))
        assert isinstance(read_scan(sequence, sequence.frames[0], sixteen), Scan)
    finally:
        path.write_bytes(whole)
