"""What a user gets wrong ends every command with status 2 and one short message that names it;
nothing is printed besides, and nothing is written or changed."""

from __future__ import annotations

import os

import pytest

from safe_envs.agents import make_problem
from safe_envs.filters.certificates.files import save_certificate
from safe_envs.filters.learning import learner_of
from safe_envs.filters.learning.collection import collect
from tests.filters.certificates.examples import disk
from tests.scripts.own_system import SYSTEM

ERRORS = """
evalute | did you mean 'evaluate'
evaluate | ENV_ID
evaluate Scalar-v0 --epsodes 3 | --episodes
evaluate Scalar-v0 --episodes many | many
evaluate Scaler-v0 | did you mean 'safe_envs/Scalar-v0'
evaluate CartPole-v1 | --filter-spec
evaluate --system LONG.py:problem | too long
evaluate --system LONG:problem | error
evaluate Pendulum-v1 --filter-spec pipe.py:spec | pipe
evaluate Scalar-v0 --filter CBF | did you mean 'cbf'
evaluate Scalar-v0 --filter LONG | unknown filter
evaluate Scalar-v0 --filter cbf:alpha=1_0 | '1_0'
evaluate Scalar-v0 --filter cbf:alpha | alpha
evaluate Scalar-v0 --filter scbf@state | --estimator
evaluate StochasticDubins-v0 --filter hocbf:q=1,1 | 'q'
evaluate StochasticDubins-v0 --filter hocbf:alpha=-1,1 | positive
evaluate StochasticDubins-v0 --filter hocbf:alpha=1 | relative degree 2
evaluate StochasticDubins-v0 --filter cbf | use hocbf or ecbf
evaluate StochasticDubins-v0 --filter ecbf:k=9,1 | poles
evaluate StochasticDubins-v0 --filter hocbf:alpha=1,2+scbf | 2 conditions
evaluate Scalar-v0 --filter none+scbf | 'none'
evaluate CubicSDEDisk-v0 --filter bayesian-scbf --learned none.npz | none.npz
evaluate CubicSDEDisk-v0 --filter bayesian-scbf --repeats 0 | repeats = 0
evaluate CubicSDEDisk-v0 --filter bayesian-scbf --repeats 2 --refine | repeats
evaluate CubicSDEDisk-v0 --filter bayesian-scbf:confidence=2 | confidence = 2
evaluate CubicSDEDisk-v0 --filter bayesian-scbf:confidence=.9:simultaneous=.9 | not both
evaluate CubicSDEDisk-v0 --filter bayesian-scbf:level=3 | level
evaluate CubicSDEDisk-v0 --filter learned-hocbf | noise
evaluate Scalar-v0 --learned pipe | pipe
evaluate Scalar-v0 --learned loop | symbolic links
evaluate Scalar-v0 --policy nominel | did you mean 'nominal'
evaluate Scalar-v0 --policy missing.zip | no such file
evaluate Scalar-v0 --policy own.py | FILE.py:NAME
evaluate Scalar-v0 --policy . | policy.npz
evaluate Scalar-v0 --policy LONG | unknown policy
evaluate Scalar-v0 --knowledge plan | did you mean 'plant'
evaluate Scalar-v0 --plant sigm=1 | did you mean 'sigma'
evaluate Scalar-v0 --plant sigma=fast | 'sigma=fast'
evaluate Scalar-v0 --plant sigma | NAME=VALUE
evaluate Scalar-v0 --plant sigma=DIGITS | sigma = inf
evaluate Scalar-v0 --barrier limt=1 | did you mean 'limit'
evaluate Scalar-v0 --barrier limit=1_0 | '1_0'
evaluate Scalar-v0 --input-bounds 1 | '1'
evaluate Scalar-v0 --input-bounds=-1_0,1 | '-1_0,1'
evaluate Scalar-v0 --input-bounds 2,1 | input_bounds
evaluate Scalar-v0 --input-bounds 0,1 --input-bounds 0,1 | input_bounds
evaluate Scalar-v0 --start 1,2 | start has 2 numbers
evaluate Scalar-v0 --start 1_0 | '1_0'
evaluate StochasticDubins-v0 --start 99,0,0 | outside the workspace
evaluate Scalar-v0 --noise -1 | noise = -1
evaluate Scalar-v0 --seed 1_0 | '1_0'
evaluate Scalar-v0 --confidence 95 | confidence = 95
evaluate Scalar-v0 --dt 0 | dt = 0
evaluate CubicSDE-v0 --dt 1e200 --horizon 1e202 | finite numbers
evaluate Scalar-v0 --episodes-out out.csv | out.csv
evaluate Scalar-v0 --json nowhere/out.json | nowhere/out.json
evaluate Scalar-v0 --json . | folder
evaluate Scalar-v0 --json pipe | pipe
evaluate Scalar-v0 --json LONG | too long
evaluate Scalar-v0 --json out.svg --plot ./out.svg | would overwrite the file of --json out.svg
evaluate Scalar-v0 --json model.npz --learned model.npz | --learned model.npz
evaluate Scalar-v0 --json model.npz --filter ddscbf:file=model.npz | --filter model.npz
evaluate Scalar-v0 --latex - --json - | mix
evaluate Scalar-v0 --plot out.pong | did you mean 'png'
evaluate Scalar-v0 --size singel --plot figure.pdf | did you mean 'single'
evaluate Scalar-v0 --size single | --plot FILE
evaluate Scalar-v0 --rare --refine | --refine
evaluate Scalar-v0 --rare --plot a.png --repeats 2 | --plot, --repeats
evaluate Scalar-v0 --particles 100 | --rare
evaluate Scalar-v0 --rare --particles 3 | particles = 3
evaluate Quadrotor-v0 --closed-loop | 4 inputs
evaluate StochasticDubins-v0 --closed-loop | 3 states
evaluate Scalar-v0 --monitoring continuous --closed-loop | control instants
evaluate ACC-v0 --sensor-noise 2 | nothing is measured
evaluate ACC-v0 --measurement=x_1 | no noise
evaluate ACC-v0 --measurement=speed:noise=1 | 'speed'
evaluate ACC-v0 --measurement=x_1:noise=-1 | noise
evaluate ACC-v0 "--measurement=__import__('os'):noise=1" | measurement
evaluate ACC-v0 --measurement=delay=-1 | delay
evaluate ACC-v0 --measurement=gap --measurement=gap | gap
evaluate ACC-v0 --measurement=LONG | measurement
evaluate StochasticDubins-v0 --measurement default | estimator
evaluate StochasticDubins-v0 --observe measurement | estimator
evaluate StochasticDubins-v0 --estimator ekf | nothing to estimate
evaluate StochasticDubins-v0 --estimator ekv | did you mean 'ekf'
evaluate StochasticDubins-v0 --estimator ekf:gain=1 | process_noise
evaluate StochasticDubins-v0 --measurement default --estimator kf | linear
evaluate StochasticDubins-v0 --measurement default --estimator ekf --delay 1 | delay
best Quadrotor-v0 | 12 coordinates
best Scalar-v0 --cells 4x | --cells
best Scalar-v0 --cells 40x40 --episodes 0 | cells
best Scalar-v0 --leaving violations | did you mean 'violation'
best Scalar-v0 --plot x.txt | 'txt'
best Scalar-v0 --measurement default | --measurement
certify Quadrotor-v0 | 12 states
certify Scalar-v0 --degree 6 --rate -1 | rate
certify Scalar-v0 --degree 6 --policy random | random
certify Scalar-v0 --held | --closed-loop
check psi.json --arb | safe-envs check
certify Scalar-v0 --degree 6 --out a.json --json a.json | two files
certify Scalar-v0 --degree 6 --seed -1 | seed
check none.json | none.json
check bad.json | JSON
check changed.json | sha256
check psi.json --state 0 | 2
check psi.json --seconds 0 | seconds = 0
check psi.json --json psi.json | would overwrite
export Scalar-v0 --filter promise:p=0.9 --horizon 0.1 --out c | promise:p=0.9
export Pendulum-v0 --filter scbf --out c --name 'a b' | a b
export Pendulum-v0 --out no/such/c | no/such
export DubinsDisk-v0 --filter backup --out c | simulates plans
render Scalar-v0 --out r.png --seed -1 | --seed = -1
render CubicSDEDisk-v0 --out run.png --filter scbf --compare none | one of them
render CubicSDEDisk-v0 --out run.avi | '.avi'
render CubicSDEDisk-v0 --out run.gif --json run.gif | would overwrite the file of --out run.gif
study nothing Scalar-v0 --out found | filters-in-training
study filters-in-training Scalar-v0 --against A3C --out found | A3C
leaderboard ACC-v0 --all --out board | one of the two
leaderboard ACC-v0 --algo pp --out board | did you mean
leaderboard ACC-v0 --page none.md --out board | none.md
leaderboard Scalar-v0 --out . | earlier version
leaderboard Scalar-v0 --out b --page deep.json | deep.json
sweep pipe --out found | pipe
sweep-report . | sweep
demo --folder own.py | own.py
train Scalar-v0 --algo dqn --out run | dqn
train Scalar-v0 --algo ppo --out own.py | own.py
train Scalar-v0 --algo ppo --resume --out run | no training
train Scalar-v0 --algo ppo --filter scbf --filter cbf --out run | one filter
train Scalar-v0 --algo ppo --intervention-penalty 1 --out run | penalty
train Scalar-v0 --algo sac --action best --out run | 'best'
train Scalar-v0 --algo ppo --promise-curriculum 0.5 --out run | promise
train Scalar-v0 --algo ppo --cost-limit 1 --out run | cost_limit
train Scalar-v0 --algo sac-lag --violation-limit 1 --out run | violation_limit
train Scalar-v0 --algo ppo-lag --cost-limit nan --out run | cost_limit = nan
train Scalar-v0 --algo ppo-lag --cost-limit 1 --violation-limit 0.1 --out run | give one
train Scalar-v0 --algo ppo-lag --set cost_limit=1 --out run | --cost-limit
train Scalar-v0 --algo ppo-lag --set multiplier_kq=1 --out run | did you mean 'multiplier_kp'
train Scalar-v0 --algo ppo --out run --set gamma | gamma
train Scalar-v0 --algo ppo --out run --set 'gamma=[1' | YAML
train Scalar-v0 --algo ppo --out run --set gamma=2020-13-45 | '2020-13-45'
train Scalar-v0 --algo ppo --out run --set n_steps=NESTED | nested
identify Scalar-v0 --method bayes --out l.npz | did you mean 'bayesian'
identify Scalar-v0 --method bayesian --out l.npz --set start=1 | did you mean 'starts'
identify Scalar-v0 --method bayesian --out l.npz --set prior=wide | 'wide'
identify DubinsDisk-v0 --method learned-hocbf --out l.npz --set hidden=8,wide | hidden
identify Scalar-v0 --method ddscbf --out l.npz --set way=3 | '3'
identify CubicSDEDisk-v0 --method bayesian --out l.npz --data damaged.npz | damaged.npz
identify CubicSDEDisk-v0 --method bayesian --out l.npz --data other.npz | another problem
identify CubicSDEDisk-v0 --method bayesian --out l.npz --data other.npz --set starts=1 | starts
identify CubicSDEDisk-v0 --method bayesian --data other.npz --out other.npz | would overwrite
identify Pendulum-v0 --method ddscbf --out l.npz --data model.npz | model.npz
identify DubinsDisk-v0 --method learned-hocbf --out l.npz --data other.npz | --data
identify --system own.py:problem --method bayesian --out l.npz | workspace
verify CubicSDEDisk-v0 --filter none | 'none'
verify CubicSDEDisk-v0 --knowledge guess | guess
"""
LONG = {"LONG": "x" * 100_000, "DIGITS": "9" * 5000, "NESTED": "[" * 3000}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files that commands can read, and cannot."""
    folder, pendulum = tmp_path_factory.mktemp("files"), make_problem("Pendulum-v0")
    for name in ("pipe", "pipe.py", "sweep.json"):
        os.mkfifo(folder / name)
    (folder / "loop").symlink_to("loop")
    save_certificate(disk(), folder / "psi.json")
    content = (folder / "psi.json").read_text()
    (folder / "changed.json").write_text(content.replace("0.080000001", "0.080000002"))
    (folder / "bad.json").write_text("{")
    (folder / "deep.json").write_text("[" * 100_000)
    (folder / "results").mkdir()
    (folder / "results" / "Scalar-v0.json").write_text('{"rows": [{"env_id": "Scalar-v0"}]}')
    (folder / "own.py").write_text(SYSTEM)
    (folder / "damaged.npz").write_bytes(b"PK")
    collect(pendulum, 5, 2).save(folder / "other.npz")
    learner_of("ddscbf")(pendulum, points=5, repetitions=2, way="direct").save(folder / "model.npz")
    return folder


def listed(folder):
    return {path: path.lstat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize("row", ERRORS.strip().splitlines())
def test_a_mistake_is_named_and_changes_nothing(safe_envs_command, folder, monkeypatch, row):
    line, _, fragment = row.rpartition(" | ")
    for name, text in LONG.items():
        line = line.replace(name, text)
    monkeypatch.chdir(folder)
    before = listed(folder)
    status, out, err = safe_envs_command(line)
    assert (status, out) == (2, "")
    assert err.startswith("Error: ")
    assert fragment in " ".join(err.split())
    assert "Traceback" not in err
    assert len(err) < 2500
    assert listed(folder) == before
