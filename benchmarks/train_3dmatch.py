"""The recipe of 3DMatch's descriptors: data sets with true flow in, weights out.

    python benchmarks/train_3dmatch.py K AK [--config small] [--steps 1000] [--out 3dmatch.pt]

Partners are keypoints of scan 0 and of scan 1 that the true flow brings together; strangers are all others of the same
pair. Half of a batch lies round a few places, one of them a moving car if there is any, so that neighbours are told
apart too. Pairs are turned and mirrored. `--config paper --device cuda` is the paper's network, for a GPU of 16 GB.
The shipped weights: `OMP_NUM_THREADS=1 python benchmarks/train_3dmatch.py build/k build/ak` on the sets of `make
checkpoint`, 11 minutes of one core.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

import augkitti
from augkitti.frames import F32, F64, pose_from_xyz_yaw, transform_points
from augkitti.scan_pair import I64
from augkitti.seeds import generator
from training.baselines.descriptor_network import CONFIGS, DescriptorNetwork, contrastive_loss, save_network
from training.baselines.matching import one_a_voxel, standing
from training.baselines.tdf import FieldConfig, distance_field, in_reach, patches
from training.sample import Sample, sample_of

SPACING_M = 0.4  # of keypoints
TOGETHER_M = 0.3  # partners lie so near to each other
APART_M = 1.0  # strangers farther than this off
BATCHES_A_PAIR = 2  # reading a pair and its fields takes as long as a step
REACH_M = 35.0  # keypoints of training: near ones teach more, and a smaller field is quicker
TURN_RAD = 0.4  # largest turn of a pair about z


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="+", type=Path)
    parser.add_argument("--config", choices=CONFIGS, default="small")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--batch", type=int, default=192, help="partners of a step, all of one pair")
    parser.add_argument("--learning-rate", type=float, default=2e-3)
    parser.add_argument("--margin", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("training/checkpoints/3dmatch_small.pt"))
    asked = parser.parse_args()
    torch.manual_seed(asked.seed)
    network = DescriptorNetwork(CONFIGS[asked.config]).to(asked.device)
    field = CONFIGS[asked.config].field
    optimiser = torch.optim.AdamW(network.parameters(), asked.learning_rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, asked.learning_rate, asked.steps, pct_start=0.1)
    facts = {name: value for name, value in vars(asked).items() if name != "out"}
    facts["data"] = [path.name for path in asked.data]
    recent: list[tuple[float, float]] = []
    start = time.perf_counter()
    for step, (patch0, patch1, xyz1) in enumerate(batches(asked.data, field, asked.batch, asked.seed, asked.steps), 1):
        both = torch.from_numpy(np.concatenate([patch0, patch1])).to(asked.device)
        feature0, feature1 = network(both).chunk(2)
        place = torch.from_numpy(xyz1.astype(np.float32)).to(asked.device)
        loss = contrastive_loss(feature0, feature1, place, asked.margin, APART_M)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        recent.append((float(loss.detach()), found(feature0.detach(), feature1.detach(), place)))
        if step % 50 == 0 or step == asked.steps:
            mean = np.mean(recent, axis=0)
            recent = []
            print(f"{step} loss {mean[0]:.4f} found {mean[1]:.3f}, {time.perf_counter() - start:.0f} s", flush=True)
            save_network(asked.out, network, {**facts, "steps_done": step, "found": round(float(mean[1]), 4)})
    print(f"{asked.out}: {asked.out.stat().st_size / 1e6:.2f} MB")


def found(feature0: torch.Tensor, feature1: torch.Tensor, xyz1: torch.Tensor) -> float:
    """Share of rows whose nearest descriptor of the batch is that of the partner, or of a neighbour of it."""
    nearest = torch.cdist(feature0, feature1).argmin(dim=1)
    return float(((xyz1[nearest] - xyz1).norm(dim=1) < APART_M).float().mean())


def batches(data: list[Path], field: FieldConfig, size: int, seed: int, steps: int) -> Iterator[tuple[F32, F32, F64]]:
    """Patches of partners (B, P, P, P) twice, and their places in scan 1 (B, 3), sets in turn."""
    sets = [augkitti.open(path, split="train") for path in data]
    field = FieldConfig(**{**vars(field), "reach_m": REACH_M})
    step = number = 0
    while step < steps:
        rng = generator(seed, number)
        pairs = sets[number % len(sets)]
        number += 1
        sample = turned(sample_of(pairs[int(rng.integers(len(pairs)))]), rng)
        xyz0, xyz1, moving = partners(sample, field)
        if len(xyz0) < size:
            continue
        field0, field1 = distance_field(sample.xyz0, field), distance_field(sample.xyz1, field)
        for _ in range(min(BATCHES_A_PAIR, steps - step)):
            rows = drawn(xyz0, moving, size, rng)
            yield patches(field0, xyz0[rows], field.patch), patches(field1, xyz1[rows], field.patch), xyz1[rows]
            step += 1


def turned(sample: Sample, rng: np.random.Generator) -> Sample:
    """A pair turned about z, and mirrored or not; only points and flow."""
    T = pose_from_xyz_yaw(0.0, 0.0, 0.0, rng.uniform(-TURN_RAD, TURN_RAD))
    T[:3, 1] *= rng.choice([-1.0, 1.0])
    values = {name: transform_points(T, getattr(sample, name)).astype(np.float32) for name in ("xyz0", "xyz1", "flow0")}
    return Sample(**{**vars(sample), **values})


def partners(sample: Sample, field: FieldConfig) -> tuple[F64, F64, I64]:
    """Keypoints of scan 0 (K, 3) with a partner in scan 1 (K, 3), and which of them are on objects."""
    rows0, rows1 = (one_a_voxel(xyz, SPACING_M, standing(xyz)) for xyz in (sample.xyz0, sample.xyz1))
    rows0 = rows0[~sample.status0[rows0]]
    moved = sample.xyz0[rows0].astype(np.float64) + sample.flow0[rows0]
    xyz1 = sample.xyz1[rows1].astype(np.float64)
    distance, nearest = cKDTree(xyz1).query(moved)
    nearest = np.minimum(nearest, len(xyz1) - 1)
    kept = (distance < TOGETHER_M) & in_reach(moved, field) & in_reach(xyz1[nearest], field)
    kept &= in_reach(sample.xyz0[rows0], field)
    return (
        sample.xyz0[rows0[kept]].astype(np.float64),
        xyz1[nearest[kept]],
        np.flatnonzero(sample.instance0[rows0[kept]] >= 0),
    )


def drawn(xyz: F64, on_objects: I64, size: int, rng: np.random.Generator) -> I64:
    """Rows (size,) of keypoints (K, 3): half of them anywhere, the rest round two places, the first on an object."""
    first = rng.choice(on_objects) if len(on_objects) else rng.integers(len(xyz))
    tree = cKDTree(xyz)
    near = [tree.query(xyz[middle], size // 4)[1] for middle in (first, rng.integers(len(xyz)))]
    taken = np.unique(np.concatenate(near))
    rest = np.setdiff1d(np.arange(len(xyz)), taken)
    return np.concatenate([taken, rng.choice(rest, min(size - len(taken), len(rest)), replace=False)])


if __name__ == "__main__":
    main()
