#!/usr/bin/env bash
# What must hold on a GPU, in under six minutes on a bare machine: one line of verdict a step, then the logs' folder.
#
#   benchmarks/gpu.sh                   needs an NVIDIA GPU, the package's dependencies and pytest; exits with 2 without CUDA
#   DEVICE=cpu benchmarks/gpu.sh        the same steps on the CPU, which tests this script
#
# PYTHON names the interpreter (.venv/bin/python), LOGS the folder of the logs (results/gpu), PATIENCE how many times as
# long as on a GPU a step may take (1; 4 on the CPU), STEPS which of them to run. A step that fails does not stop those
# after it; the exit status is 1 if one failed.
set -u
cd "$(dirname "$0")/.." || exit 1
DEVICE=${DEVICE:-cuda}
PYTHON=${PYTHON:-.venv/bin/python}
LOGS=${LOGS:-results/gpu}
PATIENCE=${PATIENCE:-$([ "$DEVICE" = cpu ] && echo 4 || echo 1)}
STEPS=${STEPS:-start keys maps table pool kernels}
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1
mkdir -p "$LOGS"

if [ "$DEVICE" = cuda ]; then
    timeout 30 "$PYTHON" benchmarks/gpu_checks.py cuda 2>"$LOGS/cuda.log" || exit 2
fi

declare -A LIMIT=([start]=60 [keys]=45 [maps]=50 [table]=60 [pool]=35 [kernels]=100) # seconds, 350 in all
failed=0
for step in $STEPS; do
    if [ "$step" = kernels ]; then # the test suite's kernel part
        command=("$PYTHON" -m pytest -q tests/kernels)
        "$PYTHON" -c "import xdist" 2>/dev/null && command+=(-n "${WORKERS:-4}" --dist loadfile)
    else
        command=("$PYTHON" benchmarks/gpu_checks.py "$step" --device "$DEVICE")
    fi
    begin=$SECONDS
    UNIFUSION_TEST_DEVICE=$DEVICE timeout --kill-after=5 $((LIMIT[$step] * PATIENCE)) "${command[@]}" >"$LOGS/$step.log" 2>&1
    status=$?
    case $status in
        0) verdict=passed ;;
        124 | 137) verdict="TOOK TOO LONG" ;;
        *) verdict="FAILED ($status)" ;;
    esac
    [ $status -eq 0 ] || failed=1
    echo "$verdict: $step, $((SECONDS - begin)) s: $(tail -n 1 "$LOGS/$step.log")"
done
echo "logs: $LOGS"
exit $failed
