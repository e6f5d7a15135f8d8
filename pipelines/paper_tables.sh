#!/bin/sh
# The paper's experiments from scans to tables: a folder in; data sets, runs and `report/index.html` in it out.
#
#   AUGKITTI_KITTI=~/kitti CAD=~/cad pipelines/paper_tables.sh paper       # all of KITTI: days, on a GPU
#   env -u AUGKITTI_KITTI N=300 CONFIG=small STEPS=700 LIMIT=30 pipelines/paper_tables.sh paper   # embedded streets
#
# Plain pairs and augmented ones of the same scans, split alike; a network trained on plain pairs and one on both, for as
# many steps; Tables 1 and 2 with the baselines, and the figures. What is there is kept: begin again after an interruption.
set -eu
out=${1:?"usage: pipelines/paper_tables.sh FOLDER"}
N=${N:-20000}                   # pairs of each set
SEED=${SEED:-0}                 # of the sets
CAD=${CAD:-}                    # folder of car models; empty: cars made in code
TEST_ON=${TEST_ON:-}            # recordings to test on; empty: a fifth of all
CONFIG=${CONFIG:-paper}         # of both networks
STEPS=${STEPS:-150000}          # of each
PROCESSES=${PROCESSES:-1}       # that train together, one a GPU
K_AK=${K_AK:-}                  # a run trained on both kinds elsewhere; empty: it is trained here
LIMIT=${LIMIT:-}                # pairs of each set and split that are scored; empty: all
BOXES=${BOXES:-network}         # whose boxes the baselines follow: network or truth
JOBS=${JOBS:-$(nproc)}           # processes that generate, and that score baselines

generate() {
    augkitti generate --n "$N" --seed "$SEED" --jobs "$JOBS" --resume "$@"
}

train() {
    run=$1
    shift
    if [ -e "$run/checkpoint.pt" ]; then set -- "$@" --resume; fi
    python -m torch.distributed.run --standalone --nproc-per-node "$PROCESSES" -m training train "$@" \
        --config "$CONFIG" --steps "$STEPS" --validation none --out "$run"
}

generate --out "$out/ak" ${CAD:+--cad "$CAD"}
generate --out "$out/k" --cars 0
if [ ! -e "$out/ak/splits.json" ]; then augkitti split "$out/ak" ${TEST_ON:+--test-on "$TEST_ON"}; fi
if [ ! -e "$out/k/splits.json" ]; then augkitti split "$out/k" --like "$out/ak/splits.json"; fi
train "$out/runs/k" --data "$out/k"
if [ -z "$K_AK" ]; then
    train "$out/runs/k_ak" --data "$out/k" --data "$out/ak"
fi
pointflownet tables --runs "$out/runs/k" "${K_AK:-$out/runs/k_ak}" --data "$out/ak" --kitti-data "$out/k" \
    --boxes "$BOXES" ${LIMIT:+--limit "$LIMIT"} --jobs "$JOBS" --out "$out/report"
