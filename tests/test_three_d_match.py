"""3DMatch + Det.: its network, and the shipped small one at work."""

from dataclasses import replace

import numpy as np
import pytest
from matched_scene import BOX, EGO, along_the_axes, corner_and_box, with_noise
from pair_factory import make_pair as cast_pair

from augkitti.errors import InputError
from augkitti.frames import pose_from_xyz_yaw
from training.baselines.followed import true_boxes
from training.metrics import rotation_error, translation_error

torch = pytest.importorskip("torch")

from training.baselines.descriptor_network import (  # noqa: E402
    PAPER,
    SMALL,
    DescriptorConfig,
    DescriptorNetwork,
    contrastive_loss,
    describe,
    load_network,
    save_network,
    shipped_network,
)
from training.baselines.tdf import FieldConfig  # noqa: E402
from training.baselines.three_d_match import (  # noqa: E402
    CONFIG,
    keypoints,
    scene_of,
    three_d_match,
    three_d_match_strong,
)

TINY = DescriptorConfig((2, 2), (4, 4, 6), 3, FieldConfig(voxel_m=0.2, patch=16))


def parameters(config):
    with torch.device("meta"):
        return sum(weight.numel() for weight in DescriptorNetwork(config).parameters())


def test_the_papers_network_has_its_14_million_parameters():
    assert parameters(PAPER) == 14_311_488
    with torch.device("meta"):
        assert DescriptorNetwork(PAPER)(torch.zeros(2, 30, 30, 30)).shape == (2, 512)


def test_layers_that_do_not_fit_the_patch_are_refused():
    with pytest.raises(ValueError, match="voxels to a side are left"):
        DescriptorNetwork(replace(SMALL, field=replace(SMALL.field, patch=30)))


def test_descriptors_have_unit_length():
    torch.manual_seed(0)
    found = describe(DescriptorNetwork(TINY), np.random.default_rng(0).random((5, 16, 16, 16), np.float32))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-5)
    assert describe(DescriptorNetwork(TINY), np.zeros((0, 16, 16, 16), np.float32)).shape == (0, 3)


def test_the_loss_draws_partners_together_and_strangers_apart():
    one = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    far = torch.tensor([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    assert contrastive_loss(one, one, far, 1.0, 1.0) == 0.0
    other = torch.tensor([[1.0, 0.0], [1.0, 0.0]])  # the second's partner looks like the first
    assert contrastive_loss(one, other, far, 1.0, 1.0) == pytest.approx(2.0 / 2 + 1.0)
    near = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])  # neither partners nor strangers
    assert contrastive_loss(one, other, near, 1.0, 1.0) == pytest.approx(1.0)


def test_a_network_comes_back_from_its_file(tmp_path):
    torch.manual_seed(0)
    network = DescriptorNetwork(TINY).half().float()
    save_network(tmp_path / "n.pt", network, {"steps": 3})
    again = load_network(tmp_path / "n.pt")
    assert again.config == TINY
    patch = np.random.default_rng(0).random((3, 16, 16, 16), np.float32)
    np.testing.assert_array_equal(describe(again, patch), describe(network, patch))


def test_a_file_that_is_no_network_is_named(tmp_path):
    (tmp_path / "n.pt").write_bytes(b"no")
    for path, why in ((tmp_path / "n.pt", "no descriptor network"), (tmp_path / "m.pt", "does not exist")):
        with pytest.raises(InputError, match=why):
            load_network(path)


def test_the_shipped_network_is_small():
    assert shipped_network().stat().st_size <= 2_000_000
    assert load_network(shipped_network()).config == SMALL


def test_motions_of_a_corner_and_a_box_are_found_to_a_fraction_of_a_voxel():
    pair, motion = corner_and_box(spacing=0.3)
    said = three_d_match_strong(pair, true_boxes(pair))
    assert translation_error(said.ego_motion, EGO) < 0.1
    assert rotation_error(said.ego_motion, EGO) < 0.01
    assert translation_error(said.motions[0], motion, BOX[:3]) < 0.2
    assert rotation_error(said.motions[0], motion) < 0.08


@pytest.mark.parametrize("method", [three_d_match, three_d_match_strong])
def test_noise_moves_the_answer_no_more_than_itself(method):
    pair, motion = corner_and_box(spacing=0.4)
    said = method(with_noise(pair, 0.02), true_boxes(pair))
    assert translation_error(said.ego_motion, EGO) < 0.05
    assert rotation_error(said.ego_motion, EGO) < 0.005
    assert translation_error(said.motions[0], motion, BOX[:3]) < 0.1
    assert rotation_error(said.motions[0], motion) < 0.07


def test_shifts_by_whole_voxels_are_found_exactly_without_care():
    ego = pose_from_xyz_yaw(-0.6, 0.6, 0.0, 0.0)
    pair, motion = corner_and_box(ego=ego, own=along_the_axes(1.2, 0.0))
    said = three_d_match(pair, true_boxes(pair))
    np.testing.assert_allclose(said.motions[0], motion, atol=1e-5)
    assert translation_error(said.ego_motion, ego) < 0.005  # look-alikes within reach of RANSAC's inliers


def test_a_scan_has_its_thousand_keypoints():
    network = load_network(shipped_network())
    found = keypoints(scene_of(cast_pair(tick_step=1).pair.scan0.xyz, network), network, CONFIG.voxel_m, CONFIG.most)
    assert len(found.xyz) >= 1000
    assert np.isfinite(found.feature).all()
