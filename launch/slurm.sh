#!/usr/bin/env bash
#SBATCH --job-name=gcd-train
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=1
#SBATCH --gpus-per-node=8
#SBATCH --cpus-per-task=64
#SBATCH --time=24:00:00
#SBATCH --signal=TERM@300
#SBATCH --open-mode=append
# Any `gcd-train` command on a Slurm cluster: `train` by torchrun, one process a GPU on every node;
# what takes --ray (generate, data compact, cache, evaluate) on a Ray cluster of the job's nodes. Stopped or out of time,
# the same line goes on. Folders must be seen by all nodes; gcd-train must be on PATH, for Ray with the extra `cluster`.
#
#   sbatch --nodes 4 --gpus-per-node 0 launch/slurm.sh generate driving runs/scenes --scenes 1533 --compact
#   sbatch launch/slurm.sh cache runs/scenes --weights pardom_gradual_rgb.ckpt --out runs/cache
#   sbatch --nodes 2 launch/slurm.sh train package:kubric-gradual-max90 --data kubric4d --out runs/k90 ...
#   sbatch launch/slurm.sh evaluate --data kubric4d --split kubric4d-test20 --weights runs/k90/... --out runs/k90-test
#
#   GPUS    processes of torchrun on a node (as many as Slurm gave)
#   PORT    of the first node, for torchrun or Ray (from the job's number)
set -euo pipefail
cd "${SLURM_SUBMIT_DIR:-.}"

NODES=${SLURM_NNODES:-1}
GPUS=${GPUS:-${SLURM_GPUS_ON_NODE:-1}}
JOB=${SLURM_JOB_ID:-0}
PORT=${PORT:-$((20000 + JOB % 20000))}
HEAD=$(scontrol show hostnames "${SLURM_JOB_NODELIST:-$(hostname)}" | head -n 1)

case ${1:?a gcd-train command} in
train)
  exec srun torchrun --nnodes "$NODES" --nproc-per-node "$GPUS" --rdzv-backend c10d --rdzv-id "$JOB" \
    --rdzv-endpoint "$HEAD:$PORT" -m gcd_train "$@"
  ;;
*)
  ray start --head --port "$PORT" --disable-usage-stats --block &
  RAY=$!
  trap 'kill $(jobs -p) 2>/dev/null || true' EXIT
  until ray status --address "$HEAD:$PORT" >/dev/null 2>&1; do
    kill -0 "$RAY" || exit 1
    sleep 1
  done
  if [ "$NODES" -gt 1 ]; then
    srun --nodes "$((NODES - 1))" --ntasks "$((NODES - 1))" --exclude "$HEAD" \
      ray start --address "$HEAD:$PORT" --disable-usage-stats --block &
  fi
  gcd-train "$@" --ray "$HEAD:$PORT"
  ;;
esac
