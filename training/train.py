"""Training: data sets and settings in, a run's folder out (checkpoint.pt, settings.yaml, log.jsonl, tensorboard/).

`train` is the loop; `one_step` is what it repeats. Under torchrun each process takes its own share of the pairs; sums
and counts of the losses are added up over processes, so that two processes do as one with the batches of both (but for
batch norm, whose statistics are of a process's own batch: `train.frozen_norms`).
"""

import json
import math
import time
from collections.abc import Generator, Mapping
from contextlib import closing
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import torch
import yaml
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from augkitti.command_line import note
from augkitti.errors import InputError, MachineError
from training.checkpoint import (
    NAME,
    Checkpoint,
    check_fits,
    fill,
    load_checkpoint,
    random_states,
    save_checkpoint,
    set_random_states,
)
from training.config import GridConfig, Settings, TrainConfig
from training.losses import Term, loss_terms
from training.network import PointFlowNet
from training.shard_dataset import ShardPairs, load_batches
from training.team import Precision, Team, team_of
from training.voxelize import Batch, empty_share

LOG, SETTINGS = "log.jsonl", "settings.yaml"
SAY_EVERY_S = 15.0


@dataclass(frozen=True)
class TrainOptions:
    """What a run is asked to do."""

    data: tuple[tuple[Path, float], ...]  # folders of data sets, with their weights
    settings: Settings
    out: Path
    split: str | None = "train"
    validation: str | None = "validation"  # None: no figures on the way
    steps: int | None = None  # None: as many as settings.train.epochs make
    minutes: float | None = None  # stop then; the cosine still goes by steps
    workers: int = 0  # processes that read and voxelise, beside each training process
    threads: int | None = None
    device: str = "auto"
    precision: Precision = "auto"
    resume: bool = False
    init: Path | None = None  # start from these weights
    save_every: int = 500  # steps
    validate_every: int = 500
    validate_pairs: int = 24


def train(options: TrainOptions) -> Path:
    """Train; the path of the last checkpoint.

    Raises:
        InputError: bad data sets or settings, a folder that is in use, a checkpoint that does not fit, a loss that is
            no number (it names the pairs of the batch).
        MachineError: disk or GPU memory gave way.
    """
    with team_of(options.device, options.precision) as processes:
        team = processes.suited_to(options.settings.network)
        if options.threads:
            torch.set_num_threads(options.threads)
        run = open_run(options, team)
        train_config, start = options.settings.train, time.perf_counter()
        with closing(Log(options.out, team, run.step)) as log, closing(batches_of(run.pairs, options)) as batches:
            log.say(run.headline(team))
            reason = no_validation(options)
            if reason:
                log.say(f"no figures on the way: {reason}")
            while run.step < run.steps:
                batch = next(batches).to(team.device)
                if team.leads and not log.done:
                    log.say(empty_voxels(batch, options.settings.grid))
                set_rate(run.optimiser, learning_rate(run.step, run.steps, train_config))
                figures = one_step(run.network, run.optimiser, batch, options.settings, team)
                run.step += 1
                log.step(run, figures, len(batch.samples) * team.size, final=run.step == run.steps)
                if options.validate_every and (run.step % options.validate_every == 0 or run.step == run.steps):
                    log.validation(run, validate(run, options, team))
                late = options.minutes is not None and any(
                    team.gather(time.perf_counter() - start > 60.0 * options.minutes)
                )
                if run.step % options.save_every == 0 or run.step == run.steps or late:
                    run.save(options, team)
                if late:
                    log.say(f"stopped after {options.minutes:g} minutes at step {run.step}; go on with --resume")
                    break
        return options.out / NAME


def one_step(
    network: nn.Module, optimiser: torch.optim.Optimizer, batch: Batch, settings: Settings, team: Team
) -> dict[str, float]:
    """One optimisation step; the losses, and the norm of the gradient before clipping.

    Raises:
        InputError: a loss or a gradient that is no number; names the batch's pairs. Weights are left as they were.
    """
    assert batch.targets is not None
    optimiser.zero_grad(set_to_none=True)
    with team.precision():
        output = network(batch.voxels0, batch.voxels1, len(batch.samples), batch.targets.columns)
    loss, figures = team_loss(loss_terms(output, batch.targets, settings), team)
    _refuse_nan(float(figures["loss"]), "loss", figures, batch)
    loss.backward()  # type: ignore[no-untyped-call]
    norm = float(nn.utils.clip_grad_norm_(network.parameters(), settings.train.clip))
    _refuse_nan(norm, "gradient", figures, batch)
    optimiser.step()
    return {**figures, "gradient": norm}


def team_loss(terms: Mapping[str, Term], team: Team) -> tuple[torch.Tensor, dict[str, float]]:
    """What to go down on, and each term's mean, both over the batches of all processes.

    DistributedDataParallel takes the mean of gradients over processes; times their number, it is the sum that is
    wanted.

    Args:
        terms: by name, of this process's batch.
        team: the processes.
    """
    names = list(terms)
    counts = team.sum(torch.stack([terms[n].count.double() for n in names]))
    sums = team.sum(torch.stack([terms[n].sum.detach().double() for n in names]))
    means = (sums / counts.clamp(min=1.0)).tolist()
    loss = torch.stack(
        [terms[n].weight * terms[n].sum * (team.size / max(float(counts[i]), 1.0)) for i, n in enumerate(names)]
    ).sum()
    whole = sum(terms[n].weight * mean for n, mean in zip(names, means, strict=True))
    return loss, {"loss": whole, **dict(zip(names, means, strict=True))}


def learning_rate(step: int, steps: int, config: TrainConfig) -> float:
    """Linear warm-up, then half a cosine down to a hundredth."""
    warm = config.warmup * steps
    if step < warm:
        return float(config.learning_rate * (step + 1) / (warm + 1))
    done = (step - warm) / max(steps - warm, 1)
    return float(config.learning_rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * done))))


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Give all parameters of an optimiser one learning rate."""
    for group in optimiser.param_groups:
        group["lr"] = rate


@dataclass(eq=False)
class Run:
    """A run under way."""

    network: nn.Module  # as the loop calls it, DistributedDataParallel where there are several processes
    plain: PointFlowNet
    optimiser: torch.optim.Optimizer
    pairs: ShardPairs
    steps: int
    step: int = 0
    facts: dict[str, Any] = field(default_factory=dict)

    def headline(self, team: Team) -> str:
        """What starts here."""
        weights = sum(p.numel() for p in self.plain.parameters())
        return (
            f"{weights / 1e6:.2f} M parameters, {self.pairs.pairs_in_epoch():,} pairs an epoch, "
            f"steps {self.step:,} to {self.steps:,}, "
            f"{team.size} process{'es' if team.size > 1 else ''} on {team.device}, {'bf16' if team.bf16 else 'fp32'}"
        )

    def save(self, options: TrainOptions, team: Team) -> None:
        """Write the run's checkpoint; the first process does."""
        if team.leads:
            save_checkpoint(
                options.out / NAME,
                Checkpoint(
                    options.settings,
                    dict(self.plain.state_dict()),
                    self.step,
                    self.pairs.digest,
                    self.optimiser.state_dict(),
                    random_states(),
                    self.pairs.state_dict(),
                    {**self.facts, "steps": self.steps, "processes": team.size},
                ),
            )
        team.wait()


def open_run(options: TrainOptions, team: Team) -> Run:
    """Network, optimiser and reader, new or as the checkpoint in `options.out` left them."""
    settings, config = options.settings, options.settings.train
    file = options.out / NAME
    if file.exists() and not options.resume:
        raise InputError(file, "is there already", "give another --out, or --resume")
    pairs = ShardPairs(options.data, options.split, settings, training=True, seed=config.seed)
    if not pairs.batches_left():
        raise InputError(options.data[0][0], f"has fewer pairs than the {team.size} processes", "start fewer")
    steps = options.steps or max(round(config.epochs * pairs.pairs_in_epoch() / (config.batch * team.size)), 1)
    torch.manual_seed(config.seed)  # every process draws the same first weights
    plain = PointFlowNet(settings)
    facts: dict[str, Any] = {}
    if options.init is not None and not options.resume:
        start = load_checkpoint(options.init)
        fill(plain, start.weights, options.init)
        facts["steps_before"] = start.all_steps
    plain = to_training(plain.to(team.device), config)
    optimiser = torch.optim.AdamW(_groups(plain, config.weight_decay), lr=config.learning_rate)
    run = Run(plain, plain, optimiser, pairs, steps, facts=facts)
    torch.manual_seed(config.seed + 1000 * team.rank)
    if options.resume:
        old = load_checkpoint(options.out)
        check_fits(old, settings, pairs.digest, file)
        fill(plain, old.weights, file)
        assert old.optimiser is not None
        optimiser.load_state_dict(old.optimiser)
        pairs.load_state_dict(old.reader)
        if team.leads:
            set_random_states(old.random)
        run.step, run.steps, run.facts = old.step, options.steps or int(old.facts["steps"]), old.facts
    elif team.leads:
        try:
            options.out.mkdir(parents=True, exist_ok=True)
            (options.out / SETTINGS).write_text(yaml.safe_dump(settings.model_dump(mode="json", by_alias=True)))
        except OSError as err:
            raise MachineError(options.out, f"cannot be written ({err.strerror})", "give another --out") from err
    team.wait()
    if team.size > 1:
        run.network = DistributedDataParallel(
            plain, device_ids=[team.device.index] if team.device.type == "cuda" else None
        )
    return run


def to_training(network: PointFlowNet, config: TrainConfig) -> PointFlowNet:
    """The same network in training mode; what does not learn (`train.parts`, `train.frozen_norms`) stays as it is.

    Raises:
        InputError: `train.parts` names no part of the network.
    """
    network.train()
    known = [name for name, _ in network.named_children()]
    for name in config.parts:
        if name not in known:
            raise InputError("train.parts", f"`{name}` is no part of the network", f"name some of {', '.join(known)}")
    for name, part in network.named_children():
        learns = not config.parts or name in config.parts
        part.requires_grad_(learns)
        for module in part.modules():
            if (config.frozen_norms or not learns) and isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
                module.eval()
    return network


def empty_voxels(batch: Batch, grid: GridConfig) -> str:
    """How much of the grid holds no point, beside the paper's figure."""
    share, scans = 0.0, len(batch.samples)
    for voxels in (batch.voxels0, batch.voxels1):
        share += 0.5 * empty_share(voxels, grid, scans)
    return f'{share:.1%} of the voxels of the first batch are empty (paper: "more than 90 %")'


def batches_of(pairs: ShardPairs, options: TrainOptions) -> Generator[Batch]:
    """Batches without end, epoch after epoch, from where `pairs` stands; it is moved on with each."""
    while True:
        at_start = deepcopy(pairs)  # worker processes begin when they begin; `pairs` may have moved on by then
        epoch = load_batches(
            at_start,
            options.settings,
            options.workers,
            pin_memory=options.device != "cpu" and torch.cuda.is_available(),
        )
        for batch in islice(epoch, pairs.batches_left()):
            pairs.batch_done()
            yield batch
        pairs.set_epoch(pairs.epoch + 1)


def no_validation(options: TrainOptions) -> str | None:
    """Why there will be no figures of the validation split though they are wanted; None where there will be."""
    if options.validation is None or not options.validate_every:
        return None
    from training.evaluate import why_no_figures

    return why_no_figures(options.data, options.validation)


def validate(run: Run, options: TrainOptions, team: Team) -> dict[str, float | None]:
    """Figures on the first pairs of the validation split; empty where there is none."""
    if options.validation is None or not team.leads:
        return {}
    from training.evaluate import quick_figures

    run.plain.eval()
    try:
        limit = options.validate_pairs
        return quick_figures(run.plain, options.settings, options.data, options.validation, limit, team)
    finally:
        to_training(run.plain, options.settings.train)


class Log:
    """Lines on screen, log.jsonl, and TensorBoard where it is installed; the first process writes."""

    def __init__(self, folder: Path, team: Team, step: int = 0) -> None:
        self.team = team
        self.file: TextIO | None = None
        self.board: Any = None
        self.start = self.said = time.perf_counter()
        self.done = self.pairs = 0
        self.since: list[dict[str, float]] = []
        if team.leads:
            _forget_after(step, folder / LOG)
            self.file = (folder / LOG).open("a", encoding="utf-8")
            try:
                from torch.utils.tensorboard import SummaryWriter

                self.board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1 if step else None)
            except ImportError:
                self.say("TensorBoard is not installed: log.jsonl alone")

    def say(self, line: str) -> None:
        """Print it, once for all processes."""
        if self.team.leads:
            note(line)

    def step(self, run: Run, figures: Mapping[str, float], pairs: int, final: bool) -> None:
        """A step is done."""
        if not self.team.leads or self.file is None:
            return
        now = time.perf_counter()
        self.done, self.pairs = self.done + 1, self.pairs + pairs
        rate = run.optimiser.param_groups[0]["lr"]
        seconds = now - self.start
        row = {"step": run.step, "epoch": run.pairs.epoch, **figures, "learning_rate": rate, "seconds": seconds}
        self._write(row, {**figures, "learning_rate": rate}, run.step)
        self.since.append(dict(figures))
        if now - self.said > SAY_EVERY_S or final:
            self.said = now
            left = (run.steps - run.step) * (now - self.start) / self.done
            means = ", ".join(f"{n} {np.mean([f[n] for f in self.since]):.3f}" for n in figures if n != "gradient")
            speed = f"{self.pairs / seconds:.1f} pairs/s, {_clock(left)} left"
            self.say(f"step {run.step:,}/{run.steps:,}: {means}; {speed}")
            self.since = []

    def validation(self, run: Run, figures: Mapping[str, float | None]) -> None:
        """Figures of the validation split came."""
        if not figures:
            return
        known = {name: value for name, value in figures.items() if value is not None}
        row = {"step": run.step, "validation": dict(figures), "seconds": time.perf_counter() - self.start}
        self._write(row, {f"validation/{n}": v for n, v in known.items()}, run.step)
        self.say(f"validation at step {run.step:,}: " + ", ".join(f"{n} {v:.3f}" for n, v in known.items()))

    def _write(self, row: Mapping[str, Any], scalars: Mapping[str, float], step: int) -> None:
        if self.file is not None:
            self.file.write(json.dumps(row) + "\n")
            self.file.flush()
        if self.board is not None:
            for name, value in scalars.items():
                self.board.add_scalar(name, value, step)

    def close(self) -> None:
        """Nothing more comes."""
        for part in (self.file, self.board):
            if part is not None:
                part.close()


def _forget_after(step: int, file: Path) -> None:
    """Take lines of later steps from a log: a run that was cut off goes on from its checkpoint, not from its log."""
    if not file.exists():
        return
    kept = []
    for line in file.read_text(encoding="utf-8").splitlines():
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line + "\n")
        except ValueError:  # cut off while it was written
            break
    file.write_text("".join(kept), encoding="utf-8")


def _groups(network: nn.Module, decay: float) -> list[dict[str, Any]]:
    """Weights decay, biases and batch norms do not."""
    parameters = [p for p in network.parameters() if p.requires_grad]
    return [
        {"params": [p for p in parameters if p.ndim > 1], "weight_decay": decay},
        {"params": [p for p in parameters if p.ndim <= 1], "weight_decay": 0.0},
    ]


def _refuse_nan(value: float, what: str, figures: Mapping[str, float], batch: Batch) -> None:
    if not math.isfinite(value):
        names = ", ".join(sample.pair_id for sample in batch.samples)
        parts = ", ".join(f"{name} {figure:g}" for name, figure in figures.items() if name != "loss")
        raise InputError(
            f"batch of {names}",
            f"its {what} is {value} ({parts})",
            "lower train.learning_rate, and begin anew with --init",
        )


def _clock(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"
