#!/usr/bin/env bash
# All GPU checks and benches, within eight minutes, into one JSON file: tools/gpu.sh [FILE, default gpu.json]
#
# `python3` (or $PYTHON) must have the project's dependencies and a torch that sees the GPU. Parts run in order of
# worth, each within its own time limit; a part that fails leaves the end of its standard error and stops no other.
# Logs are written to $LOGS, by default a temporary folder.
set -u
out=$(realpath -m "${1:-gpu.json}")
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1
python=${PYTHON:-python3}
total_s=${TOTAL_S:-470}
logs=${LOGS:-$(mktemp -d)}
mkdir -p "$logs" "$(dirname "$out")"
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1 NO_COLOR=1
rows=$logs/parts.tsv
: >"$rows"

run_part() { # NAME LIMIT_S COMMAND...
  local name=$1 limit=$2 left=$((total_s - SECONDS)) start code
  shift 2
  ((left < limit)) && limit=$left
  if ((limit < 5)); then
    printf '%s\t%s\t%s\t%s\n' "$name" skipped 0 "$*" >>"$rows"
    return
  fi
  start=$(date +%s.%N)
  timeout -k 5 "$limit" "$@" >"$logs/$name.out" 2>"$logs/$name.err" </dev/null
  code=$?
  printf '%s\t%s\t%s\t%s\n' "$name" "$code" "$(echo "$start $(date +%s.%N)" | awk '{print $2 - $1}')" "$*" >>"$rows"
  "$python" tools/gpu_checks.py merge "$logs" "$out" # so that an interrupted run leaves what it measured
  echo "$name: exit code $code after $SECONDS s" >&2
}

checks=("$python" -m tools.gpu_checks)
work=$(mktemp -d)
attack=("$python" -m drivesem attack --combo 2 --limit 3 --workers 1 --json)
run_part environment 30 "$python" tools/gpu_checks.py environment
run_part kernels 150 "${checks[@]}" kernels --device cuda
run_part step 60 "${checks[@]}" step --device cuda
run_part devices 90 "$python" -m tools.bench devices --device cuda --frames 2 --threads 1 --json --out "$work/devices"
run_part batches 60 "${checks[@]}" batches --device cuda
run_part bench_step 60 "$python" -m drivesem bench step --device cuda --quick --cars 1,4,8 --triangles 2000 --json \
  --out "$work/step"
run_part attack_cuda 70 "${attack[@]}" --device cuda --out "$work/attack_cuda"
run_part attack_cpu 70 env OMP_NUM_THREADS=1 "${attack[@]}" --device cpu --out "$work/attack_cpu"
run_part bench_render 40 "$python" -m drivesem bench render --device cuda --quick --cars 4 --triangles 2000 --json \
  --out "$work/render"
run_part tests 90 "$python" -m pytest -q --no-header -p no:cacheprovider -W default tests/gpu
rm -rf "$work"
"$python" tools/gpu_checks.py merge "$logs" "$out" && echo "$out" >&2
