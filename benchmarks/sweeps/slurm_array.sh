#!/bin/bash
# A sweep larger than one job: each task of the array is one run with its own share of the seeds, under one folder.
#   sbatch benchmarks/sweeps/slurm_array.sh
# When all have finished: python -m qdos_brax report runs/sweep/* --out runs/sweep-report
#SBATCH --job-name=qdos-sweep
#SBATCH --array=0-7
#SBATCH --gres=gpu:1
#SBATCH --time=12:00:00
#SBATCH --signal=B:TERM@120
set -eu
out="runs/sweep/$SLURM_ARRAY_TASK_ID"
if [ -e "$out/metrics.csv" ]; then # requeued: continue exactly where it was
  exec python train.py --resume "$out"
fi
exec python train.py --env antmaze-large --alpha 0.1,0.2,0.3 \
  --seed "$((4 * SLURM_ARRAY_TASK_ID)),$((4 * SLURM_ARRAY_TASK_ID + 1)),$((4 * SLURM_ARRAY_TASK_ID + 2)),$((4 * SLURM_ARRAY_TASK_ID + 3))" \
  --out "$out"
