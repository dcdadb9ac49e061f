#!/usr/bin/env bash
# Check and time every way of computing the full-size model on one GPU, in about ten minutes.
#
#   launch/bench-gpu.sh [FOLDER]        FOLDER: for the figures and logs (docs/performance)
#
# Every step keeps what it has done: after a stop, or on a machine that is lent for ten minutes at a time, run the same
# line again. The steps, each a file gpu-*.json that `tools/bench_model.py --show` prints:
#   check    the tests that only a GPU can run (gpu-check.log)
#   engines  plain torch, CUDA graphs alone, compiled alone, both, both with the decoder in float32: 25 guided steps
#   peer     ours against diffusers, as it is and compiled, in turns in one process
#   warm     a restart: the time of a whole process that finds its code compiled (gpu-restart.log)
#   memory   the most that ours and diffusers take, in processes of their own
#
#   PYTHON   the interpreter that has torch (python3)
#   WHEELS   a folder of wheels, for a machine without network; else packages come from the index
#   STEPS    which of the steps (all)
#   MINUTES  stop cleanly after so many minutes (60)
#   REPEATS  measured windows of each (20)
#   CACHE    where compiled code is kept (FOLDER/compiled)
#   OUT      where figures and logs are copied at the end (nowhere)
#   SMALL    anything: a tiny model on the CPU, to see that the script runs; its figures are worth nothing
set -euo pipefail
cd "$(dirname "$0")/.."

ROOT=${1:-docs/performance}
PYTHON=${PYTHON:-python3}
STEPS=${STEPS:-check engines peer warm memory}
REPEATS=${REPEATS:-20}
SMALL=${SMALL:-}
export PYTHONPATH="$PWD:$PWD/model:$PWD/train" GCD_CACHE_DIR="${CACHE:-$ROOT/compiled}" PYTHONUNBUFFERED=1
mkdir -p "$ROOT" "$GCD_CACHE_DIR"

for step in $STEPS; do
  case $step in
    check | engines | peer | warm | memory) ;;
    *) echo "no step is called $step: check, engines, peer, warm, memory" >&2; exit 2 ;;
  esac
done

if [ -n "$SMALL" ]; then
  MODEL=(--weights random:kubric90 --device cpu --threads 1 --height 64 --width 64 --steps 2)
  ENGINES=(--engine torch --engine graphs --engine cuda)
  PEERS=(--peer diffusers)
  REPEATS=1
else
  MODEL=(--weights random:full --device cuda --dtype bfloat16 --height 256 --width 384 --steps 25 --guidance 1 1.5)
  ENGINES=(--engine torch --engine graphs --engine compiled --engine cuda --engine cuda-float32-decoder)
  PEERS=(--peer diffusers --compiled)
  "$PYTHON" -c 'import torch; assert torch.cuda.is_available(), "no CUDA device; SMALL=1 tries the script on a CPU"'
fi

MODULES="import kornia, msgspec, safetensors, psutil, diffusers, transformers, cv2, pytest_timeout"
"$PYTHON" -c "$MODULES" 2>/dev/null ||
  "$PYTHON" -m pip install -q ${WHEELS:+--no-index --find-links "$WHEELS"} \
    kornia msgspec safetensors psutil diffusers transformers opencv-contrib-python-headless pytest pytest-timeout

limited() {
  local left=$((${MINUTES:-60} * 60 - SECONDS))
  if [ "$left" -le 0 ]; then echo "out of MINUTES before: $*; run the same line to go on" >&2; exit 0; fi
  timeout --signal=TERM "$left" "$@"
}

wanted() { [[ " $STEPS " == *" $1 "* ]] && [ ! -e "$ROOT/$2" ]; }

bench_model() {
  local file=$1
  shift
  echo "bench_model.py $* -> $file" >&2
  limited "$PYTHON" tools/bench_model.py "${MODEL[@]}" "$@" --json "$ROOT/$file.part"
  mv "$ROOT/$file.part" "$ROOT/$file"
}

keep() { if [ -n "${OUT:-}" ]; then cp "$ROOT"/gpu-*.json "$ROOT"/gpu-*.log "$OUT"/ 2>/dev/null || true; fi; }
trap keep EXIT

if wanted check gpu-check.log; then
  if limited "$PYTHON" -m pytest -m "gpu${SMALL:+ and not slow}" tests/model/test_cuda.py -rs >"$ROOT/gpu-check.log.part" 2>&1; then
    mv "$ROOT/gpu-check.log.part" "$ROOT/gpu-check.log"
  else
    tail -40 "$ROOT/gpu-check.log.part" >&2
    echo "the check failed; what is timed below may be wrong" >&2
  fi
fi
if wanted engines gpu-engines.json; then bench_model gpu-engines.json "${ENGINES[@]}" --repeats "$REPEATS" --warm 2; fi
if wanted peer gpu-peer.json; then
  bench_model gpu-peer.json --engine cuda "${PEERS[@]}" --repeats "$REPEATS" --warm 2
fi
if wanted warm gpu-restart.log; then
  before=$SECONDS
  bench_model gpu-restart.json --engine cuda --repeats 1 --warm 0
  echo "a process that loads, compiles from the cache and renders one window took $((SECONDS - before)) s" |
    tee "$ROOT/gpu-restart.log"
fi
if wanted memory gpu-memory.json; then
  bench_model gpu-memory.json --engine cuda "${PEERS[@]}" --memory --repeats 1 --warm 1
fi
echo "done; as tables: tools/bench_model.py --show $ROOT/gpu-*.json" >&2
