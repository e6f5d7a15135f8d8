"""Figures of the paper: the diagram tells the truth about its network, pictures are made from what was scored."""

from types import MappingProxyType, SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from pair_factory import make_pair  # noqa: E402
from PIL import Image  # noqa: E402
from scored_pair import SETTINGS, a_data_set, a_run, an_object, right  # noqa: E402
from scored_pair import make_pair as hand_made  # noqa: E402
from test_tables import QUICK, options  # noqa: E402
from tiny_network import tiny_settings  # noqa: E402

import training.paper_figures as module  # noqa: E402
from augkitti.scan_pair import GLASS, THROUGH_GLASS  # noqa: E402
from training import augmentation_figures  # noqa: E402
from training.augmentation_figures import (  # noqa: E402
    SOMEHOW,
    WELL,
    draw_windows,
    draw_workflow,
    find_example,
    plain_pair,
)
from training.network import PointFlowNet  # noqa: E402
from training.network_figure import draw_network, network_stages  # noqa: E402
from training.paper_scores import _close_cars  # noqa: E402
from training.score import Rules  # noqa: E402
from training.tables import tables  # noqa: E402


def test_the_diagrams_parameters_are_all_of_the_networks():
    network = PointFlowNet(tiny_settings())
    stages = network_stages(network)
    assert sum(stage.parameters for stage in stages.values()) == sum(p.numel() for p in network.parameters())
    assert stages["voxels"].shape == "16 x 12 x 8"
    assert stages["volume"].shape == "4 x 16 x 12"  # 8 cells high: 4, 2, 1
    assert stages["block3"].shape == "12 x 2 x 2"
    assert "FC 12 → 12, max over voxel" in stages["points"].layers
    assert stages["motion"].parameters == 0


def test_a_network_of_four_blocks_is_drawn_too(tmp_path):
    deeper = tiny_settings()
    blocks = (*deeper.network.blocks, (8, 1))
    network = PointFlowNet(deeper.model_copy(update={"network": deeper.network.model_copy(update={"blocks": blocks})}))
    assert network_stages(network)["block4"].shape == "8 x 1 x 1"
    draw_network(network, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_the_source_of_a_pair_is_its_measured_points():
    pair = make_pair().pair
    source = plain_pair(pair)
    measured = pair.scan0.source >= 0
    np.testing.assert_array_equal(source.scan0.xyz, pair.scan0.xyz[measured])
    assert len(source.scan0) < len(pair.scan0)
    assert source.scan0.period_s == pytest.approx(pair.time1 - pair.time0)
    assert {label.id for label in source.labels0} == {
        i.id for i in pair.objects if i.origin == "labelled" and i.box0 is not None
    }


def test_windows_and_workflow_are_drawn_from_a_car_that_is_seen_well(tmp_path):
    example = find_example([make_pair(tick_step=1).pair])  # a road between walls, as densely scanned as a street
    surfaces = [
        set(pair.scan0.surface[pair.scan0.instance == example.car].tolist())
        for pair in (example.augmented, example.opaque)
    ]
    assert THROUGH_GLASS in surfaces[0]
    assert THROUGH_GLASS not in surfaces[1]
    assert GLASS in surfaces[1]  # where panes are, though they let nothing through
    np.testing.assert_array_equal(
        example.augmented.objects[example.car].pose0, example.opaque.objects[example.car].pose0
    )
    for draw in (draw_windows, draw_workflow):
        path = tmp_path / f"{draw.__name__}.png"
        draw(example, path)
        with Image.open(path) as picture:
            assert min(picture.size) > 700
            assert len(picture.convert("RGB").getcolors(1 << 24)) > 200


def test_the_first_car_seen_well_is_shown_and_else_the_first_seen_at_all(monkeypatch):
    seen = {"far": SOMEHOW, "none": None, "near": WELL, "later": WELL}

    def tried(pair, take_any):
        demand = seen[pair]
        example = SimpleNamespace(augmented=pair, car=0)
        return example if demand is WELL or (demand is SOMEHOW and take_any) else None

    monkeypatch.setattr(augmentation_figures, "_example_in", tried)
    monkeypatch.setattr(augmentation_figures, "_is_seen", lambda pair, car, demand: seen[pair] is demand)
    for pairs, shown in ((["none", "far", "near", "later"], "near"), (["none", "far", "none"], "far")):
        left = iter(pairs)
        assert find_example(left).augmented == shown
        assert list(left) == (["later"] if shown == "near" else [])
    assert find_example(["none"]) is None


def test_close_cars_are_shown_with_their_error(tmp_path):
    pair = hand_made([an_object(10, 0), an_object(10, 3), an_object(25, -9)], points=40)
    wrong = pair.flow0 + np.where(pair.scan0.instance[:, None] == 1, [0.0, 0.8, 0.0], 0.0).astype(np.float32)

    class Again:
        rules = Rules.of(SETTINGS)
        labels = MappingProxyType({"direct": "Ours"})

        def __call__(self, name, methods=()):
            return pair, {"direct": right(pair, flows={"direct": wrong})}

    (close,) = _close_cars(pair, Again()(pair.pair_id)[1]["direct"], Again.rules)
    assert close.points == 80
    assert close.close_epe == pytest.approx(0.4)
    shown = module._failure(tmp_path, 1, pair.pair_id, Again())
    assert shown.path.name == "close1.png"
    assert shown.path.stat().st_size > 20_000


def test_every_figure_that_the_data_can_give_is_drawn(tmp_path, monkeypatch):
    for name in ("aug", "k"):
        a_data_set(tmp_path / name)
    for seed, name in enumerate(("k0", "ka0", "ka1")):
        a_run(tmp_path / name, seed=seed)
    monkeypatch.setattr(module, "find_example", lambda *_: None)  # a few hundred points are no street
    out = tmp_path / "report"
    tables(options(tmp_path, out, fig3b=(1, 1)), QUICK)
    made = {path.stem for path in (out / "figures").iterdir()}
    assert made == {"network", "fig3b", "points", "zoom", "comparison1", "comparison2"}  # no cars close to each other
    assert (out / "index.html").read_text().count("data:image/png;base64,") == len(made)
    with Image.open(out / "figures" / "comparison1.png") as picture:
        assert min(picture.size) > 800
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 50
