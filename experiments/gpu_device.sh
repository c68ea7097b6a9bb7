#!/usr/bin/env bash
# `python -m experiments.gpu` on a machine that has jax for its GPU, and no network (docs/gpu.md).
#
#   bash experiments/gpu_device.sh prepare     where there is a network: wheels into .whl
#   bash experiments/gpu_device.sh [flags]     there: installs them aside, runs with these flags
#
# Results go to $OUT, if that is set: gpu.json, gpu.md, log.txt, and of the runs what is small.
set -euo pipefail
cd "$(dirname "$0")/.."

# What such a machine lacks: it has Python 3.12 and jax, flax, optax, orbax, scipy, matplotlib.
missing="blinker brax docstring_parser Flask flask-cors glfw itsdangerous jaxopt ml_collections
  mujoco mujoco-mjx PyOpenGL tensorboardX trimesh typeguard tyro websockets"

prepare() {
  local python=python3 wanted
  [ -x .venv/bin/python ] && python=.venv/bin/python
  wanted=$(for name in $missing; do grep -ix "$name==.*" constraints.txt; done)
  rm -rf .whl
  # shellcheck disable=SC2086  # one word each
  "$python" -m pip download --quiet --no-deps --only-binary=:all: --python-version 3.12 \
    --implementation cp --platform manylinux_2_28_x86_64 --platform manylinux_2_27_x86_64 \
    --platform manylinux_2_17_x86_64 --platform manylinux2014_x86_64 \
    --platform manylinux1_x86_64 --dest .whl $wanted
  du -sh .whl
}

# Controllers, tests and reports: what a table needs, and little of what made it.
pack() {
  find runs/gpu -type f -size -1024k -not -path '*/checkpoints/*' -not -path '*/experience/*' \
    -not -path '*/replay/*' -not -name 'events*' -print0 |
    tar --null --files-from - --create --gzip --file "$1"
}

install() {
  local site=/tmp/genidm-site
  python3 -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir --upgrade \
    --target "$site" .whl/*.whl
  export PYTHONPATH="$site" PYTHONUNBUFFERED=1
  nvidia-smi --list-gpus || echo "no nvidia-smi here"
}

main() {
  local status=0
  install
  if [ -z "${OUT:-}" ]; then
    python3 -m experiments.gpu "$@"
    return
  fi
  # A call goes on from what is committed.
  cp experiments/results/gpu.json "$OUT" 2>/dev/null || true
  python3 -m experiments.gpu --results-dir "$OUT" "$@" 2>&1 | tee "$OUT/log.txt" || status=$?
  [ ! -d runs/gpu ] || pack "$OUT/runs.tar.gz"
  return "$status"
}

if [ "${1:-}" = prepare ]; then prepare; else main "$@"; fi
