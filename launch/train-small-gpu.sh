#!/usr/bin/env bash
# Train a small model on one machine with a GPU and 16 cores, rendering included, in about 25 minutes.
#
#   launch/train-small-gpu.sh [driving-small | driving-semantic-small | objects-small]
#
# Every step keeps what it has done: after a stop, or on a machine that is lent for ten minutes at a time, run the
# same line again. Afterwards: runs/MODEL-gpu/ holds the weights, the log and the evaluation.
#
#   PYTHON   the interpreter that has torch (default: python3)
#   WHEELS   a folder of wheels, for a machine without network; else packages come from the index
#   MINUTES  stop cleanly after so many minutes (default: 60)
#   CLIPS    clips to learn from (default: 4000)
#   OUT      where the result is copied (default: nowhere)
set -euo pipefail
cd "$(dirname "$0")/.."

MODEL=${1:-driving-small}
PYTHON=${PYTHON:-python3}
RUN=runs/$MODEL-gpu
CLIPS=${CLIPS:-4000}
export PYTHONPATH="$PWD:$PWD/model:$PWD/train"

case $MODEL in
  driving-small | driving-semantic-small | objects-small) ;;
  *) echo "no small model is called $MODEL: take driving-small, driving-semantic-small or objects-small" >&2; exit 2 ;;
esac

"$PYTHON" -c 'import torch; assert torch.cuda.is_available(), "no CUDA device: train with a recipe without -gpu"'
"$PYTHON" -c 'import cv2, kornia, moderngl, mujoco, msgspec, rich, safetensors, typer, zmq' 2>/dev/null ||
  "$PYTHON" -m pip install -q ${WHEELS:+--no-index --find-links "$WHEELS"} \
    kornia opencv-contrib-python-headless moderngl glcontext mujoco msgspec rich safetensors typer pyzmq

gcd_train() {
  local left=$((${MINUTES:-60} * 60 - SECONDS))
  if [ "$left" -le 0 ]; then echo "out of MINUTES before: $1; run the same line to go on" >&2; exit 0; fi
  timeout --signal=TERM "$left" "$PYTHON" -c 'from gcd_train.cli.main import main; main()' "$@"
}

keep() { if [ -n "${OUT:-}" ]; then cp -r "$RUN"/*.safetensors "$RUN"/*.jsonl "$RUN"/report* "$OUT"/ 2>/dev/null || true; fi; }
trap keep EXIT

if [ "$MODEL" = objects-small ]; then
  for world in drop tabletop; do
    gcd_train generate "$world" "$RUN/test/$world" --first-seed 1000000 --clips 20 --clips-per-scene 1
    gcd_train generate "$world" "$RUN/valid/$world" --first-seed 1000100 --clips 8 --clips-per-scene 1
    gcd_train generate "$world" "$RUN/train/$world" --clips "$((CLIPS / 2))"
  done
else
  gcd_train generate driving --out "$RUN/test" --first-seed 1000000 --clips 40
  gcd_train generate driving --out "$RUN/valid" --first-seed 1000100 --clips 16
  gcd_train generate driving --out "$RUN/train" --clips "$CLIPS"
fi
gcd_train train "package:$MODEL-gpu" --data "$RUN/train" --valid "$RUN/valid" --out "$RUN"
gcd_train evaluate --weights "$RUN/$MODEL.safetensors" --data "$RUN/test" --train "$RUN/train" --steps 1 --steps 4 --out "$RUN/report"
