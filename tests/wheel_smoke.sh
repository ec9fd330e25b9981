#!/bin/sh
# Build the wheel, install it without extras in a new environment, and use it outside the checkout.
#
#     sh tests/wheel_smoke.sh [PYTHON]
#
# The dependencies are those of constraints.txt. It takes minutes and is not part of the suite.
set -eu

python=${1:-python3}
root=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

step() { echo "== $*"; }

step "wheel"
# From a copy, since a build leaves folders behind; with the links, as in a checkout.
mkdir "$work/source"
(cd "$root" && cp -RP safe_envs wrappers agents scripts thesis benchmarks pyproject.toml README.md LICENSE "$work/source")
"$python" -m pip wheel --quiet --no-deps --wheel-dir "$work/dist" "$work/source"

step "contents of the wheel"
(cd "$root" && git ls-files safe_envs) > "$work/tracked.txt"
"$python" - "$work"/dist/safe_envs-*.whl "$work/tracked.txt" <<'END'
import sys
from collections import Counter
from pathlib import Path
from zipfile import ZipFile

names = [name for name in ZipFile(sys.argv[1]).namelist() if ".dist-info/" not in name]
tracked = set(Path(sys.argv[2]).read_text().split())
assert {name.split("/")[0] for name in names} == {"safe_envs"}, names
assert max(Counter(names).values()) == 1, Counter(names).most_common(3)
assert tracked <= set(names), f"missing in the wheel: {sorted(tracked - set(names))}"
stale = {name for name in names if name not in tracked and "__pycache__" not in name}
assert not stale, f"not tracked: {sorted(stale)}"
END

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
from importlib.util import find_spec
from pathlib import Path

import safe_envs.agents
import safe_envs.scripts
import safe_envs.testing
import safe_envs.wrappers

inside = Path(sys.argv[1]).resolve()
for package in (safe_envs, safe_envs.wrappers, safe_envs.agents, safe_envs.scripts):
    assert Path(package.__file__).resolve().is_relative_to(inside), package.__file__
for name in ("wrappers", "agents", "scripts"):
    assert find_spec(name) is None, f"a second import root: {name}"
assert files("safe_envs").joinpath("py.typed").is_file()
assert safe_envs.__version__ == version("safe-envs")
END

step "gym.make"
python - <<'END'
import gymnasium as gym

import safe_envs
from safe_envs.wrappers import SafetyFilterWrapper

for env_id in safe_envs.ENV_IDS:
    env = gym.make(env_id)
    env = SafetyFilterWrapper(env, env.unwrapped.problem.filter)
    env.reset(seed=0)
    env.step(env.action_space.sample())
try:
    env = gym.make("safe_envs/Scalar-v0", render_mode="rgb_array")
    env.reset(seed=0)
    env.render()
except gym.error.DependencyNotInstalled as error:
    assert ".[render]" in str(error), error
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
safe-envs reproduce all 2>&1 | grep -q "python -m thesis"

step "plug-ins from files"
cat > plug_ins.py <<'END'
from dataclasses import dataclass

from safe_envs.wrappers import SCBF


@dataclass(frozen=True)
class Cautious(SCBF):
    name = "cautious"


def policy(observations):
    return 0.5 * observations
END
safe-envs evaluate Scalar-v0 --filter plug_ins.py:Cautious --policy plug_ins.py:policy --episodes 20 --quiet

step "errors name what is missing"
refused() {
    expected=$1
    shift
    if "$@" > /dev/null 2> refused.txt; then
        echo "not refused: $*" && exit 1
    fi
    grep -q -F "$expected" refused.txt || { cat refused.txt && exit 1; }
}
refused '.[tensorboard]' safe-envs train Scalar-v0 --algo ppo --n-timesteps 512 --out other --tensorboard logs
refused '.[render]' safe-envs render Scalar-v0 --out film.mp4
refused "did you mean 'scbf'" safe-envs evaluate Scalar-v0 --filter scfb

step "passed"
