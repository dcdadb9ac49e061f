#!/usr/bin/env bash
# What only a GPU can show, on a bare host: check the code, time the full-size model, train the live model.
#
#   launch/gpu.sh check [FOLDER]       the tests that only a GPU can run -> gpu-check.log
#   launch/gpu.sh bench [FOLDER]       every engine beside plain torch, and ours beside diffusers, 25 guided steps; a
#                                      restart with its code compiled; memory -> gpu-*.json, `tools/bench_model.py --show`
#   launch/gpu.sh train [FOLDER]       package:live-small-gpu, while other processes film its clips -> FOLDER/run
#
# FOLDER is docs/performance, of train runs/live. Every step keeps what it has done: the same line again goes on.
#
#   PYTHON   the interpreter that has torch (python3)
#   WHEELS   a folder of wheels, for a machine without network; else what is missing comes from the index
#   MINUTES  stop check and bench cleanly after so many minutes (60)
#   REPEATS  measured windows of each (20)
#   CACHE    where compiled code is kept (FOLDER/compiled)
#   OUT      where figures, logs and weights are copied at the end (nowhere)
#   SMALL    anything, of train a tiny recipe: tiny on the CPU, to see that the script runs
set -euo pipefail
cd "$(dirname "$0")/.."

VERB=${1:-}
case $VERB in
  check | bench) ROOT=${2:-docs/performance} MODULES="kornia msgspec safetensors psutil diffusers transformers cv2 pytest_timeout" ;;
  train) ROOT=${2:-runs/live} MODULES="kornia msgspec safetensors imagesize tomli_w zstandard moderngl mujoco cv2" ;;
  *) echo "launch/gpu.sh takes check, bench or train, got '$VERB'" >&2; exit 2 ;;
esac
PYTHON=${PYTHON:-python3}
REPEATS=${REPEATS:-20}
SMALL=${SMALL:-}
export PYTHONPATH="$PWD:$PWD/model:$PWD/train" GCD_CACHE_DIR="${CACHE:-$ROOT/compiled}" PYTHONUNBUFFERED=1
mkdir -p "$ROOT"

if [ -n "$SMALL" ]; then
  MODEL=(--weights random:kubric90 --device cpu --threads 1 --height 64 --width 64 --steps 2)
  ENGINES=(graphs cuda)
  PEERS=(--peer diffusers)
  REPEATS=1
else
  MODEL=(--weights random:full --device cuda --dtype bfloat16 --height 256 --width 384 --steps 25 --guidance 1 1.5)
  ENGINES=(graphs compiled cuda cuda-float32-decoder)
  PEERS=(--peer diffusers --compiled)
  "$PYTHON" -c 'import torch; assert torch.cuda.is_available(), "no CUDA device; SMALL=1 tries the script on a CPU"'
fi

declare -A PACKAGES=([cv2]=opencv-contrib-python-headless [pytest_timeout]=pytest-timeout [tomli_w]=tomli-w)
for module in $MODULES; do
  "$PYTHON" -c "import $module" 2>/dev/null ||
    "$PYTHON" -m pip install -q ${WHEELS:+--no-index --find-links "$WHEELS"} "${PACKAGES[$module]:-$module}"
done

keep() { if [ -n "${OUT:-}" ]; then cp "$ROOT"/gpu-*.{json,log} "$ROOT"/run/*.safetensors "$OUT"/ 2>/dev/null || true; fi; }
trap keep EXIT

limited() {
  local left=$((${MINUTES:-60} * 60 - SECONDS))
  if [ "$left" -le 0 ]; then echo "out of MINUTES before: $*; run the same line to go on" >&2; exit 0; fi
  timeout --signal=TERM "$left" "$@"
}

bench_model() {
  local file=$ROOT/gpu-$1.json
  shift
  if [ -e "$file" ]; then return; fi
  echo "bench_model.py $* -> $file" >&2
  limited "$PYTHON" tools/bench_model.py "${MODEL[@]}" "$@" --json "$file.part"
  mv "$file.part" "$file"
}

check() {
  local log=$ROOT/gpu-check.log
  if [ -e "$log" ]; then return; fi
  limited "$PYTHON" -m pytest -m "gpu${SMALL:+ and not slow}" tests/model/test_cuda.py -rs 2>&1 | tee "$log.part"
  mv "$log.part" "$log"
}

bench() {
  for engine in "${ENGINES[@]}"; do
    bench_model "$engine" --engine torch --engine "$engine" --repeats "$REPEATS" --warm 2
  done
  bench_model peer --engine cuda "${PEERS[@]}" --repeats "$REPEATS" --warm 2
  bench_model restart --engine cuda --repeats 1 --warm 0
  bench_model memory --engine cuda "${PEERS[@]}" --memory --repeats 1 --warm 1
  echo "as tables: tools/bench_model.py --show $ROOT/gpu-*.json" >&2
}

train() {
  local few=${SMALL:+1} recipe=package:live-small-gpu
  OMP_NUM_THREADS=1 "$PYTHON" -m gcd_train generate live "$ROOT/valid" --first-seed 1000100 --scenes "${few:-8}"
  OMP_NUM_THREADS=1 "$PYTHON" -m gcd_train generate live "$ROOT/data" ${few:+--scenes "$few"} &
  local films=$!
  if [ -n "$SMALL" ]; then wait "$films"; recipe=$SMALL; fi
  while ! compgen -G "$ROOT/data/*/*.safetensors" >/dev/null; do sleep 1; done
  "$PYTHON" -m gcd_train train "$recipe" --data "$ROOT/data" --valid "$ROOT/valid" --out "$ROOT/run"
  kill "$films" 2>/dev/null || true
}

"$VERB"
