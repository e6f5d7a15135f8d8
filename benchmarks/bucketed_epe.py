"""Three-way and bucketed errors beside those of PyPI's `bucketed-scene-flow-eval` on the same arrays: a data set in.

    pip install bucketed-scene-flow-eval      # pulls in open3d, opencv and torch
    python benchmarks/bucketed_epe.py aug --pairs 20

Prints both programs' figures for ego-motion by registration with noise upon it, and the largest difference. Theirs
takes flow over ground, so the true ego-motion's is subtracted from both flows beforehand.
"""

import contextlib
import io
import tempfile
from itertools import islice
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from augkitti.dataset import open_dataset
from training.baselines import ego_registration, rigid_flow
from training.predictions import Prediction
from training.score import CLASSES, Rules, score_pairs, truth_of

METHOD = "ego_registration"


def main(
    data: Annotated[Path, typer.Argument(help="Folder of a data set.")],
    pairs: Annotated[int, typer.Option(min=1)] = 20,
    noise_m: Annotated[float, typer.Option(help="Standard deviation of what is added to each point's flow.")] = 0.1,
) -> None:
    from bucketed_scene_flow_eval import datastructures as ds
    from bucketed_scene_flow_eval.eval import BucketedEPEEvaluator, ThreeWayEPEEvaluator

    rules, chosen, said = Rules(), list(islice(open_dataset(data), pairs)), {}
    for number, pair in enumerate(chosen):
        one = ego_registration(pair)
        noise = np.random.default_rng(number).normal(0.0, noise_m, one.flows[METHOD].shape)
        flow = (one.flows[METHOD] + noise).astype(np.float32)
        said[pair.pair_id] = Prediction(pair.pair_id, {METHOD: flow}, one.where, one.ego_motion)
    row = score_pairs(chosen, [lambda pair: said[pair.pair_id]], rules).report().rows[0]

    groups = {"BACKGROUND": ["BACKGROUND"], "FOREGROUND": ["CAR"]}
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        names = dict(enumerate(CLASSES))
        bucketed = BucketedEPEEvaluator(names, output_path=Path(folder) / "bucketed")
        three_way = ThreeWayEPEEvaluator(dict(enumerate(CLASSES[:2])), groups, output_path=Path(folder) / "three")
        for number, pair in enumerate(chosen):
            truth = truth_of(pair, rules)
            still = rigid_flow(pair.ego_motion, pair.scan0.xyz[truth.rows])
            predicted, true = said[pair.pair_id].flows[METHOD][truth.rows] - still, truth.flow - still
            everything = np.ones(len(truth.rows), bool)
            for evaluator, kind in ((bucketed, truth.kind), (three_way, truth.fg.astype(np.int64))):
                cloud = ds.SupervisedPointCloudFrame(
                    ds.PointCloud(truth.xyz), ds.PoseInfo.identity(), everything, kind.astype(ds.SemanticClassId)
                )
                frame = ds.TimeSyncedSceneFlowFrame(
                    pc=cloud, auxillary_pc=None, rgbs=None, log_id=pair.pair_id, log_idx=number, log_timestamp=number,
                    flow=ds.EgoLidarFlow(true, everything),
                )  # fmt: skip
                evaluator.eval(ds.EgoLidarFlow(predicted, everything), frame)
        theirs = bucketed.compute_results(save_results=False)
        theirs_three = three_way.compute_results(save_results=False)

    ours = {
        "FD": (row["three_way"]["fd"], theirs_three["FOREGROUND"][1]),
        "FS": (row["three_way"]["fs"], theirs_three["FOREGROUND"][0]),
        "BS": (row["three_way"]["bs"], theirs_three["BACKGROUND"][0]),
    }
    for name, one in row["bucketed"].items():
        if name != "mean":
            ours[f"{name} static"] = (one["static_epe"], theirs[name][0])
            ours[f"{name} dynamic"] = (one["dynamic_error"], theirs[name][1])
    print(f"{len(chosen)} pairs of {data.name}")
    print("| figure | ours | theirs |\n|---|---|---|")
    largest = 0.0
    for name, (mine, other) in ours.items():
        mine = np.nan if mine is None else mine
        if np.isnan(mine) != np.isnan(other):
            largest = np.inf
        elif not np.isnan(mine):
            largest = max(largest, abs(mine - other))
        print(f"| {name} | {mine:.6f} | {other:.6f} |")
    print(f"largest difference {largest:.1e}")


if __name__ == "__main__":
    typer.run(main)
