"""Settings: what the paper and method.md fix, and what is refused."""

import pytest

from augkitti.errors import InputError
from training.config import NAMES, GridConfig, Settings, load_settings


def test_paper_is_what_the_paper_and_voxelnet_have():
    paper = load_settings("paper")
    assert paper.grid.shape == (352, 400, 10)
    assert paper.grid.voxel_m == (0.2, 0.2, 0.4)
    assert paper.grid.max_points == 35
    assert paper.network.vfe[-1] == 128
    assert not paper.network.reflectance
    assert [layers for _, layers in paper.network.blocks] == [4, 6, 6]
    assert paper.detection.anchor_m == (3.9, 1.6, 1.56)
    assert (paper.detection.positive_iou, paper.detection.negative_iou) == (0.6, 0.45)
    assert (paper.detection.nms_iou, paper.loss.positive, paper.loss.negative) == (0.3, 1.5, 1.0)
    assert paper.loss.object == 1.0  # a departure where it is more
    assert not paper.train.frozen_norms


def test_small_covers_the_nearest_quarter_of_the_area_in_coarser_voxels():
    assert load_settings("small").grid.shape == (88, 100, 8)


@pytest.mark.parametrize("name", NAMES)
def test_shipped_settings_are_the_same_after_writing_and_reading(name, tmp_path):
    import yaml

    settings = load_settings(name)
    path = tmp_path / "settings.yaml"
    path.write_text(yaml.safe_dump(settings.model_dump(mode="json", by_alias=True)))
    assert load_settings(str(path)) == settings
    assert Settings.model_validate_json(settings.model_dump_json(by_alias=True)) == settings


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("grid: {voxel_m: [0.3, 0.2, 0.4]}", "no whole number of voxels"),
        ("grid: {x_m: [0.0, 0.8]}", "multiples of 8 and 4"),
        ("grid: {x_m: [5.0, 5.0]}", "no whole number of voxels"),
        ("train: {batch: 0}", "train.batch"),
        ("train: {learning_rate: .nan}", "train.learning_rate"),
        ("loss: {lambda: -1}", "loss.lambda"),
        ("network: {depth: 3}", "network.depth"),
        ("network: {vfe: [15, 48]}", "those of vfe even"),
        ("network: {blocks: []}", "not empty"),
        ("network: {rigid: [0, 3]}", "1 or more"),
        ("[1, 2]", "odd.yaml"),
        ("grid: {", "odd.yaml"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(tmp_path, text, words):
    (tmp_path / "odd.yaml").write_text(text)
    with pytest.raises(InputError) as error:
        load_settings(str(tmp_path / "odd.yaml"))
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_settings_that_are_not_there_are_told_in_one_line():
    with pytest.raises(InputError, match="medium: no such settings; give paper or small, or a YAML file"):
        load_settings("medium")


def test_the_digest_is_of_what_makes_checkpoints_exchangeable():
    one = Settings()
    assert one.digest() == Settings(train=one.train.model_copy(update={"learning_rate": 1.0})).digest()
    assert one.digest() != Settings(grid=GridConfig(max_points=10)).digest()
