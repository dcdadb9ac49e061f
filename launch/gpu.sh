#!/usr/bin/env bash
# What only a GPU can show, on a bare host: check the code, time the full-size model, train the live model.
#
#   launch/gpu.sh check [FOLDER]       the tests that only a GPU can run, the full-size one last -> gpu-check*.log
#   launch/gpu.sh bench [FOLDER]       our engine and diffusers beside plain torch, 25 guided steps; a restart with its
#                                      code compiled; memory; parts of the engine alone, a file each as soon as it is
#                                      measured -> gpu-*.json, `tools/bench_model.py --show`
#   launch/gpu.sh train [FOLDER]       package:live-small-gpu, while other processes film its clips -> FOLDER/run
#
# FOLDER is docs/performance, of train runs/live. Every step keeps what it has done: the same line again goes on.
# What a host has is used, PYTHONPATH too; only modules that are missing are installed.
#
#   PYTHON   the interpreter that has torch (python3)
#   WHEELS   a folder of wheels, for a machine without network; else what is missing comes from the index
#   MINUTES  stop check and bench cleanly after so many minutes (9: hosts that are lent end a command at ten)
#   REPEATS  measured windows of each (5)
#   CACHE    where compiled code is kept (FOLDER/compiled)
#   OUT      where figures and logs (one archive) and weights (in parts, if over 16 MB) are copied at the end (nowhere)
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
REPEATS=${REPEATS:-5}
SMALL=${SMALL:-}
export PYTHONPATH="$PWD:$PWD/client:$PWD/model:$PWD/train${PYTHONPATH:+:$PYTHONPATH}"
export GCD_CACHE_DIR="${CACHE:-$ROOT/compiled}" PYTHONUNBUFFERED=1
mkdir -p "$ROOT"

if [ -n "$SMALL" ]; then
  MODEL=(--weights random:kubric90 --device cpu --threads 1 --height 64 --width 64 --steps 2)
  ENGINES=(graphs)
  PEERS=(--peer diffusers)
  REPEATS=1
else
  MODEL=(--weights random:full --device cuda --dtype bfloat16 --height 256 --width 384 --steps 25 --guidance 1 1.5)
  ENGINES=(cuda-float8 cuda-float32-decoder compiled graphs cuda-tuned)
  PEERS=(--peer diffusers --compiled)
  "$PYTHON" -c 'import torch; assert torch.cuda.is_available(), "no CUDA device; SMALL=1 tries the script on a CPU"'
fi

declare -A PACKAGES=([cv2]=opencv-contrib-python-headless [pytest_timeout]=pytest-timeout [tomli_w]=tomli-w)
for module in $MODULES; do
  "$PYTHON" -c "import $module" 2>/dev/null ||
    "$PYTHON" -m pip install -q --timeout 10 --retries 1 ${WHEELS:+--no-index --find-links "$WHEELS"} "${PACKAGES[$module]:-$module}"
done

keep() {
  if [ -z "${OUT:-}" ]; then return; fi
  local weights found
  mapfile -t found < <(cd "$ROOT" && find . -maxdepth 2 \( -name 'gpu-*' -o -path './run/*.json*' -o -path './run/*.csv' \) -type f)
  if [ ${#found[@]} -gt 0 ]; then tar -czf "$OUT/gpu-$VERB.tar.gz" -C "$ROOT" "${found[@]}"; fi
  for weights in "$ROOT"/run/*.safetensors; do
    if [ ! -e "$weights" ]; then continue; fi
    if [ "$(stat -c %s "$weights")" -le 16000000 ]; then cp "$weights" "$OUT"; else
      split -b 16000000 -d "$weights" "$OUT/$(basename "$weights").part"  # cat NAME.part* > NAME
    fi
  done
}
trap keep EXIT

limited() {
  local left=$((${MINUTES:-9} * 60 - SECONDS)) code=0
  if [ "$left" -gt 0 ]; then timeout --signal=TERM "$left" "$@" || code=$?; else code=124; fi
  if [ "$code" = 124 ]; then
    echo "out of MINUTES at: $*; run the same line to go on" >&2
    exit 0
  fi
  return "$code"
}

bench_model() {
  local file=$ROOT/gpu-$1.json
  shift
  if [ -e "$file" ]; then return; fi
  echo "bench_model.py $* -> $file" >&2
  limited "$PYTHON" tools/bench_model.py "${MODEL[@]}" "$@" --json "$file.part"
  mv "$file.part" "$file"
}

tested() {
  local log=$ROOT/gpu-$1.log
  shift
  if [ -e "$log" ]; then return; fi
  limited "$PYTHON" -m pytest tests/model/test_cuda.py -rs "$@" >"$log.part" 2>&1 || { tail -40 "$log.part" >&2; exit 1; }
  tail -3 "$log.part" >&2
  mv "$log.part" "$log"
}

check() {
  tested check -m "gpu and not slow"
  if [ -z "$SMALL" ]; then tested check-full -m "gpu and slow"; fi
}

bench() {
  local timed=(--repeats "$REPEATS" --warm 1)
  bench_model cuda --engine torch --engine cuda "${timed[@]}"
  bench_model peer --engine cuda "${PEERS[@]}" "${timed[@]}"
  bench_model restart --engine cuda --repeats 1 --warm 0
  bench_model memory --engine cuda --peer diffusers --memory --repeats 1 --warm 1
  for engine in "${ENGINES[@]}"; do bench_model "$engine" --engine torch --engine "$engine" "${timed[@]}"; done
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
