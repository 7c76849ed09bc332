#!/bin/bash
# Ray on Slurm: the first node is the head, the others join it. Not run by us: no Slurm was at hand.
#   sbatch --nodes=8 docs/scale/slurm.sh
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=32
#SBATCH --time=24:00:00
set -euo pipefail
SHARED=${SHARED:-/shared/me}          # a folder that every node sees
source "$SHARED/venv/bin/activate"    # with lerobot_policy_v2p[scale]
export RAY_USAGE_STATS_ENABLED=0 MUJOCO_GL=egl

mapfile -t nodes < <(scontrol show hostnames "$SLURM_JOB_NODELIST")
head=${nodes[0]}:6379
srun --nodes=1 --ntasks=1 -w "${nodes[0]}" ray start --head --port=6379 --include-dashboard=false --num-cpus="$SLURM_CPUS_PER_TASK" --block &
sleep 20
for node in "${nodes[@]:1}"; do
  srun --nodes=1 --ntasks=1 -w "$node" ray start --address="$head" --num-cpus="$SLURM_CPUS_PER_TASK" --block &
done
sleep 20
# On the head's node, so that the driver finds a raylet beside it.
srun --overlap --nodes=1 --ntasks=1 -w "${nodes[0]}" \
  v2p generate "$SHARED/videos" --out "$SHARED/run" --repo-id USER/NAME --engine=ray --address="$head"
