#!/usr/bin/env bash
# The study at small scale, whole: do the paper's findings hold for four small driving models? Design and figures are in
# docs/evaluation.md. About three hours of one CPU core; every step keeps what it has done: after a stop, run the same
# line again.
#
#   launch/small-study.sh [FOLDER]      FOLDER: for data, latents, trainings, evaluations, report (runs/small-study)
#
#   DATA     a folder that holds train/, valid/ and test/, each with gradual/ and direct/; nothing is generated then
#   CLIPS, VALID, TEST   pairs to learn from, to watch and to measure on, where they are generated (500, 8, 40)
#   THREADS  of CPU computation (1)
#   HEXPLANE whether HexPlane is measured, too, by far the slowest baseline (yes); UPDATES, RAYS how long it learns a clip
#            (200 of 512 rays, a tenth of what `gcd-train evaluate` takes by default)
#   LPIPS    a folder with LPIPS weights; without one that column stays empty
#   SMALL    anything: a tiny form of it all, to see that it runs; its figures are worth nothing
#   PYTHON   the interpreter that has torch (python3)
set -euo pipefail
cd "$(dirname "$0")/.."

ROOT=${1:-runs/small-study}
PYTHON=${PYTHON:-python3}
SMALL=${SMALL:-}
SUFFIX=${SMALL:+-small}
THREADS=${THREADS:-1}
export OMP_NUM_THREADS=$THREADS PYTHONPATH="$PWD:$PWD/model:$PWD/train"

if [ -n "$SMALL" ]; then
  CLIPS=2 VALID=1 TEST=2
  FORM=(--width 64 --height 32 --frames 4 --oversample 1)
else
  CLIPS=${CLIPS:-500} VALID=${VALID:-8} TEST=${TEST:-40}
  FORM=()
fi

gcd_train() {
  echo "gcd-train $*" >&2
  "$PYTHON" -c 'import sys; from gcd_train.cli.main import main; sys.argv[0] = "gcd-train"; main()' "$@"
}

if [ -z "${DATA:-}" ]; then
  DATA=$ROOT/data
  for path in gradual direct; do
    gcd_train generate driving --path "$path" --out "$DATA/train/$path" --clips "$CLIPS" "${FORM[@]}"
    gcd_train generate driving --path "$path" --out "$DATA/valid/$path" --clips "$VALID" --first-seed 1000100 "${FORM[@]}"
    gcd_train generate driving --path "$path" --out "$DATA/test/$path" --clips "$TEST" --first-seed 1000000 "${FORM[@]}"
  done
fi

TRAIN=(${SMALL:+--small} --threads "$THREADS" --latents "$ROOT/latents")
PRETRAINED=$ROOT/study-pretrain/study-pretrain$SUFFIX.safetensors

gcd_train train package:study-pretrain --data "$DATA/train" --valid "$DATA/valid" --out "$ROOT/study-pretrain" "${TRAIN[@]}"
for path in gradual direct; do
  gcd_train train "package:study-$path-pretrained" --data "$DATA/train/$path" --valid "$DATA/valid/$path" \
    --out "$ROOT/study-$path-pretrained" "${TRAIN[@]}" --set "model.weights=$PRETRAINED"
  gcd_train train "package:study-$path-scratch" --data "$DATA/train/$path" --valid "$DATA/valid/$path" \
    --out "$ROOT/study-$path-scratch" "${TRAIN[@]}" --set "model.weights=$PRETRAINED"
done

METHODS=copy_source,ground_homography,reproject_rgbd,vanilla_svd
if [ "${HEXPLANE:-yes}" = yes ]; then METHODS=$METHODS,hexplane_1; fi
BUDGET=(--hexplane-updates "${UPDATES:-200}" --hexplane-rays "${RAYS:-512}")
MEASURE=(${LPIPS:+--lpips "$LPIPS"} --views last)

for path in gradual direct; do
  for start in pretrained scratch; do
    model=study-$path-$start
    gcd_train evaluate --weights "$ROOT/$model/$model$SUFFIX.safetensors" --no-baselines \
      --data "$DATA/test/$path" --out "$ROOT/evaluated/$model" "${MEASURE[@]}"
  done
done
gcd_train evaluate --methods "$METHODS" --svd "$PRETRAINED" \
  --data "$DATA/test/gradual" --out "$ROOT/evaluated/baselines" "${BUDGET[@]}" "${MEASURE[@]}"

"$PYTHON" tools/study_findings.py "$ROOT"/evaluated/* --out "$ROOT/findings" ${SMALL:+--small}
gcd_train report "$ROOT"/evaluated/* --out "$ROOT/report"
