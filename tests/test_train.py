"""The loop: exact resume, two processes as one, schedules, guards, and each bad input in one line."""

import json
import math
import os
import socket
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

torch = pytest.importorskip("torch")

import yaml  # noqa: E402
from pair_factory import metadata  # noqa: E402
from tiny_network import tiny_sample, tiny_settings  # noqa: E402
from tiny_shards import write_tiny_set  # noqa: E402
from torch import nn  # noqa: E402

import training.train as loop  # noqa: E402
from augkitti.errors import InputError, MachineError  # noqa: E402
from augkitti.shards import read_pairs, write_shard  # noqa: E402
from training.checkpoint import load_checkpoint  # noqa: E402
from training.cli import app  # noqa: E402
from training.config import Settings, load_settings  # noqa: E402
from training.losses import Term  # noqa: E402
from training.network import PointFlowNet  # noqa: E402
from training.team import Team, find_device, team_of, wants_bf16  # noqa: E402
from training.train import TrainOptions, learning_rate, one_step, team_loss, to_training, train  # noqa: E402
from training.voxelize import make_batch  # noqa: E402

pytestmark = [
    pytest.mark.filterwarnings("ignore:This DataLoader will create"),
    pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning"),  # fork, Python 3.12
]
SETTINGS = tiny_settings()
ALONE = Team(0, 1, torch.device("cpu"), False)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """8 pairs to train on, 1 to validate on, none to test on."""
    folder = tmp_path_factory.mktemp("aug")
    write_tiny_set(
        folder,
        {"0001": (5, 3), "0002": (1,)},
        {"train": ("0001",), "validation": ("0002",), "test": ()},
        tick_step=128,
    )
    return folder


def options(data: Path, out: Path, settings: Settings = SETTINGS, **more) -> TrainOptions:
    return TrainOptions(
        **{
            "data": ((data, 1.0),),
            "settings": settings,
            "out": out,
            "steps": 6,
            "validation": None,
            "precision": "fp32",
            "device": "cpu",
            **more,
        }
    )


def log_of(out: Path) -> list[dict]:
    rows = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


def settings_file(folder: Path, settings: Settings = SETTINGS) -> str:
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump(settings.model_dump(mode="json", by_alias=True)))
    return str(path)


class Killed(BaseException):
    """What ends a run from outside."""


@pytest.mark.parametrize("workers", [0, 1])
def test_a_run_that_was_cut_off_goes_on_with_the_same_losses(data, tmp_path, monkeypatch, workers):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    train(options(data, whole, workers=workers))
    taken = []

    def step_until_killed(*arguments):
        if len(taken) == 5:  # the last checkpoint is of step 3, in the middle of the first epoch of 4 steps
            raise Killed
        taken.append(one_step(*arguments))
        return taken[-1]

    with monkeypatch.context() as patch:
        patch.setattr(loop, "one_step", step_until_killed)
        with pytest.raises(Killed):
            train(options(data, cut, workers=workers, save_every=3))
    assert [row["step"] for row in log_of(cut)] == [1, 2, 3, 4, 5]
    with (cut / "log.jsonl").open("a") as log:
        log.write('{"step": 6, "validation": {"fg_epe": 0.1}')  # killed while writing
    torch.rand(3)  # the state of the world does not matter
    train(options(data, cut, workers=workers, resume=True))
    assert log_of(cut) == log_of(whole)
    assert [row["epoch"] for row in log_of(whole)] == [0, 0, 0, 0, 1, 1]
    one, other = (load_checkpoint(run) for run in (whole, cut))
    assert all(value.equal(other.weights[name]) for name, value in one.weights.items())
    assert one.reader == other.reader


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


def _in_a_team(rank: int, size: int, port: int, given: TrainOptions) -> None:
    os.environ.update(
        RANK=str(rank), LOCAL_RANK=str(rank), WORLD_SIZE=str(size), MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port)
    )
    torch.set_num_threads(1)
    train(given)


def train_in_two(given: TrainOptions) -> None:
    """As torchrun does, but forked: torch need not be imported twice more."""
    torch.multiprocessing.start_processes(_in_a_team, (2, free_port(), given), nprocs=2, start_method="fork")


def test_two_processes_are_one_with_the_doubled_batch(data, tmp_path):
    # batch norms frozen: their statistics are of a process's own batch
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # so that there are no threads to lose in a fork
    try:
        train_in_two(options(data, tmp_path / "two", tiny_settings(batch=2, frozen_norms=True), steps=5))
    finally:
        torch.set_num_threads(threads)
    train(options(data, tmp_path / "one", tiny_settings(batch=4, frozen_norms=True), steps=5))
    rows = [log_of(tmp_path / name) for name in ("one", "two")]
    assert len(rows[0]) == len(rows[1]) == 5
    for one, two in zip(*rows, strict=True):
        assert one == pytest.approx(two, rel=2e-3)
        assert one["flow"] == pytest.approx(two["flow"], rel=1e-3)
    assert rows[0][0] == pytest.approx(rows[1][0], rel=1e-5)  # before any rounding has been learned
    assert load_checkpoint(tmp_path / "two").facts["processes"] == 2


def test_sums_and_counts_of_all_processes_are_added_before_they_are_divided():
    class Two(Team):
        def sum(self, values):
            return values.detach() + torch.tensor([8.0, 0.0], dtype=torch.float64)[: len(values)].to(values.dtype)

    two = Two(0, 2, torch.device("cpu"), False)
    value = torch.tensor(4.0, requires_grad=True)
    terms = {"flow": Term(3.0, value, torch.tensor(2)), "boxes": Term(1.0, 0.0 * value, torch.tensor(0))}
    loss, figures = team_loss(terms, two)
    assert figures["flow"] == pytest.approx((4 + 8) / (2 + 8))
    assert figures["boxes"] == 0.0
    assert figures["loss"] == pytest.approx(3 * 1.2)
    loss.backward()
    assert value.grad == pytest.approx(3.0 / 10 * 2)  # halved again by the mean over processes


def test_frozen_batch_norms_keep_their_statistics():
    network = PointFlowNet(SETTINGS)
    before = {name: value.clone() for name, value in network.named_buffers()}
    batch = make_batch([tiny_sample(0), tiny_sample(1)], SETTINGS)
    for frozen in (True, False):
        to_training(network, SETTINGS.train.model_copy(update={"frozen_norms": frozen}))
        network(batch.voxels0, batch.voxels1, 2)
        assert network.training
        assert all(value.equal(before[name]) for name, value in network.named_buffers()) == frozen


def test_a_loss_that_is_no_number_names_the_batch_and_changes_no_weight():
    network = PointFlowNet(SETTINGS)
    nn.init.constant_(network.ego_motion_regressor.last.bias, float("nan"))
    before = {name: value.detach().clone() for name, value in network.named_parameters()}
    optimiser = torch.optim.AdamW(network.parameters(), lr=1.0)
    batch = make_batch([tiny_sample(3), tiny_sample(4)], SETTINGS)
    with pytest.raises(InputError, match="batch of tiny/3/0, tiny/4/0: its loss is nan") as error:
        one_step(network, optimiser, batch, SETTINGS, ALONE)
    assert "ego nan" in str(error.value)
    assert "\n" not in str(error.value)
    for name, value in network.named_parameters():
        np.testing.assert_array_equal(value.detach(), before[name])


def test_a_gradient_that_is_no_number_names_the_batch(monkeypatch):
    network = PointFlowNet(SETTINGS)
    next(network.parameters()).register_hook(lambda grad: grad * float("inf"))
    batch = make_batch([tiny_sample(3), tiny_sample(4)], SETTINGS)
    with pytest.raises(InputError, match="batch of tiny/3/0, tiny/4/0: its gradient is"):
        one_step(network, torch.optim.AdamW(network.parameters()), batch, SETTINGS, ALONE)


def test_the_learning_rate_rises_then_falls_as_a_cosine():
    config = SETTINGS.train.model_copy(update={"learning_rate": 1.0, "warmup": 0.1})
    rates = np.array([learning_rate(step, 100, config) for step in range(100)])
    assert (np.diff(rates[:10]) > 0).all()
    assert rates[0] == pytest.approx(1 / 11)
    assert rates[10] == rates.max() == 1.0
    assert (np.diff(rates[10:]) < 0).all()
    assert rates[55] == pytest.approx(0.01 + 0.99 * 0.5)
    assert rates[-1] < 0.012
    assert learning_rate(0, 1, config) > 0.0


def test_gradients_are_clipped_and_the_norm_is_told(monkeypatch):
    network = PointFlowNet(SETTINGS)
    batch = make_batch([tiny_sample(0), tiny_sample(1)], SETTINGS)
    gentle = SETTINGS.model_copy(update={"train": SETTINGS.train.model_copy(update={"clip": 1e-3})})
    told = one_step(network, torch.optim.SGD(network.parameters(), lr=0.0), batch, gentle, ALONE)["gradient"]
    norm = math.sqrt(sum(p.grad.square().sum().item() for p in network.parameters()))
    assert norm == pytest.approx(1e-3, rel=1e-3)
    assert told > 1.0


def test_the_screen_tells_size_empty_voxels_rate_and_time_left(data, tmp_path, capsys):
    train(options(data, tmp_path / "run", steps=2, validation="validation"))
    screen = capsys.readouterr().out
    assert "8 pairs an epoch, steps 0 to 2, 1 process on cpu, fp32" in screen
    assert '% of the voxels of the first batch are empty (paper: "more than 90 %")' in screen
    assert "step 2/2: loss" in screen
    assert "pairs/s, 0 s left" in screen
    assert "validation at step 2:" in screen
    rows = log_of(tmp_path / "run")
    assert {"step", "loss", "flow", "rigid", "ego", "positive", "negative", "boxes", "gradient"} <= set(rows[0])
    assert "validation" in rows[-1]
    assert (tmp_path / "run" / "settings.yaml").is_file()


def test_a_finished_run_is_not_overwritten_and_others_settings_do_not_go_on(data, tmp_path):
    train(options(data, tmp_path, steps=1))
    with pytest.raises(InputError, match="is there already"):
        train(options(data, tmp_path, steps=1))
    with pytest.raises(InputError, match="made with other settings: train"):
        train(options(data, tmp_path, tiny_settings(clip=1.0), resume=True))
    narrow = SETTINGS.model_copy(update={"network": SETTINGS.network.model_copy(update={"upsampled": 2})})
    with pytest.raises(InputError, match="of another network or grid than --config") as error:
        train(options(data, tmp_path, narrow, resume=True))
    assert "\n" not in str(error.value)


def test_only_the_named_parts_learn(data, tmp_path):
    first = load_checkpoint(train(options(data, tmp_path / "a", steps=1)))
    config = SETTINGS.train.model_copy(update={"parts": ("object_decoder",)})
    part = SETTINGS.model_copy(update={"train": config})
    second = load_checkpoint(train(options(data, tmp_path / "b", part, steps=2, init=tmp_path / "a")))
    for name, value in first.weights.items():  # running figures of batch norms among them
        assert value.equal(second.weights[name]) != name.startswith("object_decoder"), name
    unknown = SETTINGS.model_copy(update={"train": config.model_copy(update={"parts": ("head",)})})
    with pytest.raises(InputError, match="`head` is no part of the network; name some of feature_encoder"):
        train(options(data, tmp_path / "c", unknown))


def test_a_run_starts_from_anothers_weights(data, tmp_path):
    first = load_checkpoint(train(options(data, tmp_path / "a", steps=1)))
    slow = tiny_settings(learning_rate=1e-12, weight_decay=0.0)
    second = load_checkpoint(train(options(data, tmp_path / "b", slow, steps=1, init=tmp_path / "a")))
    weights = [name for name, _ in PointFlowNet(SETTINGS).named_parameters()]
    assert all(torch.allclose(first.weights[name], second.weights[name], atol=1e-9) for name in weights)
    assert (second.step, second.all_steps) == (1, 2)
    train(options(data, tmp_path / "b", slow, steps=2, resume=True))
    assert load_checkpoint(tmp_path / "b").all_steps == 3


def test_a_run_stops_after_its_minutes_and_can_go_on(data, tmp_path, capsys):
    train(options(data, tmp_path, steps=3, minutes=1e-9))
    assert "stopped after 1e-09 minutes at step 1; go on with --resume" in capsys.readouterr().out
    assert load_checkpoint(tmp_path).step == 1
    train(options(data, tmp_path, steps=3, resume=True))
    assert [row["step"] for row in log_of(tmp_path)] == [1, 2, 3]


def test_out_of_memory_is_one_line(data, tmp_path, monkeypatch):
    def too_much(*arguments):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.\nGPU 0 has ...")

    monkeypatch.setattr(PointFlowNet, "forward", too_much)
    with pytest.raises(MachineError, match=r"cpu: CUDA out of memory; lower train.batch") as error:
        train(options(data, tmp_path / "a"))
    assert "\n" not in str(error.value)
    said = CliRunner().invoke(
        app, ["train", "--data", str(data), "--out", str(tmp_path / "b"), "--config", settings_file(tmp_path)]
    )
    assert said.exit_code == 3
    assert said.stderr.splitlines() == [said.stderr.strip()]


@pytest.mark.parametrize(
    "words",
    ["[enforce fail] can't allocate memory: you tried\nto", "DataLoader worker (pid 3) is killed by signal: Killed."],
)
def test_a_machine_that_gives_way_is_one_line(words):
    with pytest.raises(MachineError, match=r"lower train.batch or --workers") as error, team_of("cpu", "fp32"):
        raise RuntimeError(words)
    assert "\n" not in str(error.value)
    with pytest.raises(RuntimeError, match="shapes differ"), team_of("cpu", "fp32"):  # a mistake of ours stays one
        raise RuntimeError("shapes differ")


def bad_input(data: Path, tmp_path: Path, *more: str) -> str:
    """The one line of `train`, which must end with exit code 2."""
    said = CliRunner().invoke(
        app,
        ["train", "--data", str(data), "--out", str(tmp_path / "run"), "--config", settings_file(tmp_path), *more],
    )
    assert said.exit_code == 2, said.output
    (line,) = said.stderr.splitlines()
    assert line.startswith("pointflownet: ")
    return line


def test_missing_and_empty_splits_are_one_line(data, tmp_path):
    write_tiny_set(tmp_path / "whole", {"0001": (1,)})
    assert "splits.json" in bad_input(tmp_path / "whole", tmp_path)
    assert "holds no pair in test" in bad_input(data, tmp_path, "--split", "test")
    assert "has no split `trial`" in bad_input(data, tmp_path, "--split", "trial")
    assert not (tmp_path / "run").exists()


def test_a_truncated_shard_is_one_line(tmp_path):
    folder = tmp_path / "aug"
    write_tiny_set(folder, {"0001": (2,)}, {"train": ("0001",), "validation": (), "test": ()})
    (shard,) = (folder / "data").glob("*.parquet")
    shard.write_bytes(shard.read_bytes()[:-300])
    assert shard.name in bad_input(folder, tmp_path, "--workers", "1")


def test_shards_of_another_contract_are_one_line(tmp_path):
    folder = tmp_path / "aug"
    write_tiny_set(folder, {"0001": (1,)}, {"train": ("0001",), "validation": (), "test": ()})
    (shard,) = (folder / "data").glob("*.parquet")
    write_shard(shard, list(read_pairs(shard)), {**metadata(), "contract": 2})
    assert "has contract version 2; this program reads 1" in bad_input(folder, tmp_path)
    index = json.loads((folder / "dataset.json").read_text())
    (folder / "dataset.json").write_text(json.dumps({**index, "contract": 3}))
    assert "has contract version 3; this program reads 1" in bad_input(folder, tmp_path)


def test_odd_options_are_one_line(data, tmp_path):
    assert "no such settings" in bad_input(data, tmp_path, "--config", "medium")
    (tmp_path / "odd.yaml").write_text("train: {speed: 3}\n")
    assert "train.speed" in bad_input(data, tmp_path, "--config", str(tmp_path / "odd.yaml"))
    assert "`x` of" in bad_input(tmp_path / "none=x", tmp_path)
    assert "is no device" in bad_input(data, tmp_path, "--device", "abacus")
    assert "does not exist" in bad_input(data, tmp_path, "--resume")
    assert "does not exist" in bad_input(data, tmp_path, "--init", str(tmp_path / "none"))
    if not torch.cuda.is_available():
        assert "no CUDA GPU is at hand" in bad_input(data, tmp_path, "--device", "cuda")


def test_precision_is_what_is_asked_for_and_by_itself_what_the_device_has(monkeypatch):
    cpu = find_device("cpu")
    assert wants_bf16(cpu, "bf16")
    assert not wants_bf16(cpu, "fp32")
    for has in (True, False):
        monkeypatch.setattr("training.team._has_amx", lambda has=has: has)
        assert wants_bf16(cpu, "auto") is has
    with team_of("cpu", "bf16") as team, team.precision():
        assert torch.is_autocast_enabled("cpu")


def test_a_narrow_network_runs_in_float32_on_a_processor_unless_asked_otherwise():
    paper, small = (load_settings(name).network for name in ("paper", "small"))
    auto = Team(0, 1, torch.device("cpu"), bf16=True, auto=True)
    assert auto.suited_to(paper).bf16
    assert not auto.suited_to(small).bf16
    assert Team(0, 1, torch.device("cpu"), bf16=True).suited_to(small).bf16
    assert Team(0, 1, torch.device("cuda"), bf16=True, auto=True).suited_to(small).bf16


def test_tensorboard_has_the_losses_of_each_step(data, tmp_path):
    pytest.importorskip("tensorboard")
    train(options(data, tmp_path, steps=1))
    (events,) = (tmp_path / "tensorboard").iterdir()
    assert all(name in events.read_bytes() for name in (b"flow", b"rigid", b"ego", b"learning_rate"))
