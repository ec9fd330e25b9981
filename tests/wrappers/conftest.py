"""Problems, and things learned of them in a moment."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.filters.learning.bayesian import identify
from safe_envs.filters.learning.data import Signature
from safe_envs.filters.learning.generator import learn_generator
from safe_envs.filters.learning.models.generator import GeneratorModel, LearnedGenerator
from safe_envs.filters.learning.models.residual import LearnedResidual, ResidualModel
from tests.conftest import problem_of
from tests.wrappers.learned import NO_RECORD, some_network


@pytest.fixture(scope="session")
def disk():
    return problem_of("safe_envs/DubinsDisk-v0")


@pytest.fixture(scope="session")
def top():
    return problem_of("safe_envs/Pendulum-v0")


@pytest.fixture(scope="session")
def gap():
    return problem_of("safe_envs/ACCGap-v0")


@pytest.fixture(scope="session")
def cubic():
    return problem_of("safe_envs/CubicSDEDisk-v0")


@pytest.fixture(scope="session")
def rotors():
    return problem_of("safe_envs/Quadrotor-v0")


@pytest.fixture(scope="session")
def residual(disk):
    rng, coordinates = np.random.default_rng(0), disk.sampling_domain.coordinates
    network, heldout = (
        some_network(rng, len(coordinates), 3, "relu"),
        abs(rng.normal(size=(40, 3))) * 0.05,
    )
    return ResidualModel(
        Signature.of(disk),
        NO_RECORD,
        (LearnedResidual(disk.plant.states, coordinates, 2, network, heldout),),
    )


@pytest.fixture(scope="session")
def network(top):
    coordinates = top.sampling_domain.coordinates
    network = some_network(np.random.default_rng(1), len(coordinates), 1, "tanh")
    return GeneratorModel(
        Signature.of(top), NO_RECORD, (LearnedGenerator(top.plant.states, coordinates, (network,)),)
    )


@pytest.fixture(scope="session")
def diffusion(gap):
    return learn_generator(gap, points=100, repetitions=100)


@pytest.fixture(scope="session")
def posterior(cubic):
    return identify(cubic, starts=300, repetitions=20)


@pytest.fixture(scope="session")
def gap_posterior(gap):
    return identify(gap, starts=300, repetitions=20)
