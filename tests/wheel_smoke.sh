#!/bin/sh
# Builds a wheel, installs it without extras in an environment of its own, and uses it outside of the repository.
#
#     sh tests/wheel_smoke.sh [PYTHON]
#
# The dependencies are those of constraints.txt. It takes minutes, and is no part of the suite.
set -eu

python=${1:-python3}
root=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

step() { echo "== $*"; }

step "wheel"
# From a copy: a build leaves folders behind.
mkdir "$work/source"
(cd "$root" && cp -R safe_envs wrappers agents scripts pyproject.toml README.md LICENSE "$work/source")
"$python" -m pip wheel --quiet --no-deps --wheel-dir "$work/dist" "$work/source"

step "install"
"$python" -m venv "$work/venv"
PATH="$work/venv/bin:$PATH"
export PATH
unset PYTHONPATH || true
pip install --quiet --disable-pip-version-check --constraint "$root/constraints.txt" "$work"/dist/safe_envs-*.whl
pip check

mkdir "$work/elsewhere"
cd "$work/elsewhere"

step "import"
python - "$work/venv" <<'END'
import sys
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

import safe_envs.agents
import safe_envs
import safe_envs.scripts
import safe_envs.wrappers

inside = Path(sys.argv[1]).resolve()
for package in (safe_envs, wrappers, agents, scripts):
    assert Path(package.__file__).resolve().is_relative_to(inside), package.__file__
for package in ("safe_envs", "wrappers", "agents"):
    assert files(package).joinpath("py.typed").is_file(), package
assert safe_envs.__version__ == version("safe-envs")
for algorithm in ("ppo", "a2c", "sac", "td3"):
    assert files("agents").joinpath("hyperparams", f"{algorithm}.yml").is_file(), algorithm
END

step "gym.make"
python - <<'END'
import gymnasium as gym

import safe_envs
from safe_envs.wrappers import SafetyFilterWrapper

for env_id in safe_envs.ENV_IDS:
    bare = gym.make(env_id)
    env = SafetyFilterWrapper(bare, bare.unwrapped.problem.filter)
    env.reset(seed=0)
    env.step(env.action_space.sample())
try:
    env = gym.make("safe_envs/Scalar-v0", render_mode="rgb_array")
    env.reset(seed=0)
    env.render()
except gym.error.DependencyNotInstalled as error:
    assert "safe-envs[render]" in str(error), error
else:
    raise AssertionError("a picture without pygame")
END

step "commands"
safe-envs list --json list.json > list.txt
grep -q DubinsObstacles list.txt
safe-envs doctor
safe-envs evaluate CubicSDEDisk-v0 --filter none --filter scbf --episodes 20 --plot picture.png
test -s picture.png
test "$(python -m safe_envs evaluate Scalar-v0 --episodes 20 --json - | python -c 'import json, sys; print(len(json.load(sys.stdin)["rows"]))')" = 2
safe-envs train Scalar-v0 --algo ppo --n-timesteps 512 --num-envs 4 --set n_steps=64 --out agent --quiet
safe-envs evaluate Scalar-v0 --policy agent --filter none --episodes 20 --quiet
safe-envs reproduce figure-6.2 --quick --jobs 1 --out report
test -s report/index.html

step "what is missing is named"
refused() {
    expected=$1
    shift
    if "$@" > /dev/null 2> refused.txt; then
        echo "not refused: $*" && exit 1
    fi
    grep -q -F "$expected" refused.txt || { cat refused.txt && exit 1; }
}
refused 'safe-envs[tensorboard]' safe-envs train Scalar-v0 --algo ppo --n-timesteps 512 --out other --tensorboard logs
refused 'safe-envs[render]' safe-envs render Scalar-v0 --out film.mp4
refused "did you mean 'scbf'" safe-envs evaluate Scalar-v0 --filter scfb

step "all is well"
