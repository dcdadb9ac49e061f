#!/usr/bin/env bash
# The study at small scale, whole: do the paper's findings hold for small models, on the road and for things that fall?
# Design and figures are in docs/evaluation.md. Parts run one after the other, or each in a shell of its own, on a core of
# its own; every step keeps what it has done: after a stop, run the same line again.
#
#   launch/small-study.sh [FOLDER [PART ...]]    FOLDER: for data, latents, trainings, evaluations, report (runs/small-study)
#
#   PART     driving  gradual against direct, pretrained against scratch, with the source's points shown (exact or estimated
#                     depth) against without, and baselines, on pairs of the driving world
#            drop     the same and goals up to 90 against 180 degrees, on scenes in Kubric-4D's layout
#            report   what is found, of all that was measured by then
#            by default all of them
#
#   SEEDS    of the trainings: each is trained once for each (1 2 3)
#   CLIPS, SCENES, VALID, TEST   driving pairs and drop scenes to learn from, scenes to watch and to measure on (500, 60, 8, 40)
#   THREADS  of CPU computation (1)
#   HEXPLANE whether HexPlane is measured, too, by far the slowest baseline (yes); UPDATES, RAYS how long it learns a clip
#            (200 of 512 rays, a tenth of what `gcd-train evaluate` takes by default)
#   LPIPS    a folder with LPIPS weights; without one that column stays empty
#   SMALL    anything: a tiny form of it all, to see that it runs; its figures are worth nothing
#   PYTHON   the interpreter that has torch (python3)
set -euo pipefail
cd "$(dirname "$0")/.."

ROOT=${1:-runs/small-study}
PARTS=("${@:2}")
if [ ${#PARTS[@]} = 0 ]; then PARTS=(driving drop report); fi
PYTHON=${PYTHON:-python3}
SMALL=${SMALL:-}
THREADS=${THREADS:-1}
export OMP_NUM_THREADS=$THREADS PYTHONPATH="$PWD:$PWD/model:$PWD/train"

if [ -n "$SMALL" ]; then
  SEEDS=${SEEDS:-1} CLIPS=2 SCENES=2 VALID=1 TEST=2
  PAIRS=(--width 64 --height 32 --frames 4 --oversample 1) WHOLE=(--width 64 --height 32 --frames 12 --oversample 1)
else
  SEEDS=${SEEDS:-1 2 3} CLIPS=${CLIPS:-500} SCENES=${SCENES:-60} VALID=${VALID:-8} TEST=${TEST:-40}
  PAIRS=() WHOLE=(--width 192 --height 128 --compact)
fi
TRAIN=(${SMALL:+--small} --threads "$THREADS" --latents "$ROOT/latents")
MEASURE=(${LPIPS:+--lpips "$LPIPS"} --views last --hexplane-updates "${UPDATES:-200}" --hexplane-rays "${RAYS:-512}")
BASELINES=copy_source,reproject_rgbd,vanilla_svd
if [ "${HEXPLANE:-yes}" = yes ]; then BASELINES=$BASELINES,hexplane_1; fi

gcd_train() {
  echo "gcd-train $*" >&2
  "$PYTHON" -c 'import sys; from gcd_train.cli.main import main; sys.argv[0] = "gcd-train"; main()' "$@"
}

learned() { # NAME RECIPE FOLDER-OF-DATA [PART-OF-IT] [OPTION ...]: a training, whose weights are $ROOT/NAME/NAME.safetensors
  gcd_train train "package:$2" --data "$3/train/$4" --valid "$3/valid/$4" --out "$ROOT/$1" --set "name=$1" \
    "${TRAIN[@]}" "${@:5}"
}

driving() {
  local data=$ROOT/data path start splat variant seed name first=study-pretrain
  for path in gradual direct; do
    gcd_train generate driving --path "$path" --out "$data/train/$path" --clips "$CLIPS" "${PAIRS[@]}"
    gcd_train generate driving --path "$path" --out "$data/valid/$path" --clips "$VALID" --first-seed 1000100 "${PAIRS[@]}"
    gcd_train generate driving --path "$path" --out "$data/test/$path" --clips "$TEST" --first-seed 1000000 "${PAIRS[@]}"
  done
  learned "$first" study-pretrain "$data" ""
  gcd_train evaluate --methods "$BASELINES,ground_homography" --svd "$ROOT/$first/$first.safetensors" \
    --data "$data/test/gradual" --out "$ROOT/evaluated/baselines" "${MEASURE[@]}"
  for seed in $SEEDS; do
    for variant in "gradual pretrained none" "gradual scratch none" "direct pretrained none" "direct scratch none" \
      "gradual pretrained given" "gradual pretrained estimated"; do
      read -r path start splat <<<"$variant"
      name=study-$path-$start-$splat
      name=${name%-none}-s$seed
      learned "$name" study "$data" "$path" --set "seed=$seed" --set "data.path=$path" --set "model.splat=$splat" \
        --set "model.weights=$ROOT/$first/$first.safetensors" --set "model.scratch=$(from_nothing "$start")"
      gcd_train evaluate --weights "$ROOT/$name/$name.safetensors" --no-baselines \
        --data "$data/test/$path" --out "$ROOT/evaluated/$name" "${MEASURE[@]}"
    done
  done
}

drop() {
  local data=$ROOT/drop seed variant name path reach start first=study-drop-pretrain
  local clips=(--exact --trajectories 1 --samples 1 --data "$data/test")
  gcd_train generate drop --out "$data/train" --scenes "$SCENES" "${WHOLE[@]}"
  gcd_train generate drop --out "$data/valid" --scenes "$VALID" --first-seed 1000100 "${WHOLE[@]}"
  gcd_train generate drop --out "$data/test" --scenes "$TEST" --first-seed 1000000 "${WHOLE[@]}"
  learned "$first" study-drop-pretrain "$data" ""
  local methods=(--methods "$BASELINES" --svd "$ROOT/$first/$first.safetensors") # beside the first model, in its size
  for seed in $SEEDS; do
    for variant in "gradual 90 pretrained" "gradual 180 pretrained" "direct 90 pretrained" "direct 180 pretrained" \
      "gradual 90 scratch" "gradual 180 scratch"; do
      read -r path reach start <<<"$variant"
      name=study-drop-$path-$reach-$start-s$seed
      learned "$name" study-drop "$data" "" --set "seed=$seed" --set "data.path=$path" --set "model.family=kubric$reach" \
        --set "data.orbit.max_azimuth_deg=$reach" --set "data.orbit.max_elevation_deg=$((reach / 3))" \
        --set "model.weights=$ROOT/$first/$first.safetensors" --set "model.scratch=$(from_nothing "$start")"
      gcd_train evaluate --weights "$ROOT/$name/$name.safetensors" "${methods[@]}" \
        "${clips[@]}" --out "$ROOT/evaluated/$name" "${MEASURE[@]}"
      methods=(--no-baselines)
    done
  done
}

report() {
  "$PYTHON" tools/study_findings.py "$ROOT"/evaluated/* --out "$ROOT/findings"
  gcd_train report "$ROOT"/evaluated/* --out "$ROOT/report"
}

from_nothing() {
  if [ "$1" = scratch ]; then echo true; else echo false; fi
}

for part in "${PARTS[@]}"; do
  case $part in
    driving | drop | report) "$part" ;;
    *) echo "PART is driving, drop or report, got $part" >&2 && exit 64 ;;
  esac
done
