"""Certificates that are true or false by hand."""

from __future__ import annotations

import functools
from dataclasses import replace
from fractions import Fraction

import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.filters.certificates.certificate import BarrierCertificate, Plant
from safe_envs.filters.certificates.matching import plant_of
from safe_envs.registry import make_problem

x, y, u = sp.symbols("x y u", real=True)
R = sp.Rational
F = Fraction


def in_line(psi, *, drift=0, sigma=1, h=None, ends=(0, 4), **numbers):
    """A certificate of dx = drift dt + sigma dW with a control that does nothing; psi is a list of
    coefficients of x."""
    plant = Plant(
        states=(x,),
        workspace=(tuple(map(sp.sympify, ends)),),
        inputs=(u,),
        bounds=((R(-1), R(1)),),
        drift=(sp.sympify(drift),),
        input_matrix=((R(0),),),
        diffusion=((sp.sympify(sigma),),),
        barriers=(x * (sp.pi - x) if h is None else h,),
    )
    coefficients = {(k,): F(v) for k, v in enumerate(psi)}
    found = {"rate": 0, "shortfall": 0, "supremum": 1, "horizon": 1} | numbers
    numbers = {name: F(value) for name, value in found.items()}
    return BarrierCertificate(
        "", {}, plant, Polynomial((x,), (F(0),), (F(1),), coefficients), **numbers
    )


def brownian(**numbers):
    """Brownian motion on (0, pi), psi = 3.1 x - x^2 - .001 < 0 at both ends, A psi = -1."""
    found = {"shortfall": "1.000000001", "supremum": "2.401500001"} | numbers
    return in_line(["-0.001", "3.1", "-1"], **found)


@functools.cache
def disk_plant():
    return plant_of(make_problem("safe_envs/CubicSDEDisk-v0"))


def disk(coefficients=None, **numbers):
    """h of CubicSDEDisk, whose Ah is -.08 at the origin and more elsewhere along the best input."""
    found = {
        "rate": 0,
        "shortfall": "0.080000001",
        "supremum": "1.000000001",
        "horizon": 1,
    } | numbers
    plant = disk_plant()
    psi = Polynomial(
        plant.states,
        (F(0), F(0)),
        (F(1), F(1)),
        coefficients or {(0, 0): F(1), (2, 0): F(-1), (0, 2): F(-1)},
    )
    numbers = {name: F(value) for name, value in found.items()}
    return BarrierCertificate("safe_envs/CubicSDEDisk-v0", {}, plant, psi, **numbers)


def scaled(certificate, factor):
    psi = certificate.psi
    larger = {key: value * F(factor) for key, value in psi.coefficients.items()}
    return replace(certificate, psi=replace(psi, coefficients=larger))


def with_plant(certificate, **parts):
    return replace(certificate, plant=replace(certificate.plant, **parts))


TRUE = {
    "a line": brownian(),
    "rate": brownian(rate="0.5"),
    "the disk": disk(),
    "the disk by 1e-6": disk(shortfall="0.080001", supremum="1.000001"),
    "several barriers": with_plant(brownian(), barriers=(x, sp.pi - x)),
    "a root": in_line(
        ["-0.01", "2", "-1"], drift=sp.sqrt(1 + x**2), h=2 - x, shortfall=6, supremum="1.1"
    ),
    "a policy": with_plant(disk(), policy=(R(-10),)),
    "a policy that the bounds clip": with_plant(
        disk(), policy=(-20 - disk_plant().states[0] ** 2,)
    ),
    "a kink": in_line(["-0.01", "2", "-1"], drift=sp.Abs(x - 1), h=x, shortfall=3, supremum="1.1"),
    "a turn": in_line(
        ["3", "0", "-1"],
        drift=sp.sin(x) / 10,
        h=R(1),
        ends=(-sp.pi, sp.pi),
        shortfall="1.4",
        supremum="3.1",
    ),
    "two states and a root of their squares": with_plant(
        disk(), barriers=(R(101, 100) - sp.sqrt(sum(s**2 for s in disk_plant().states)),)
    ),
}

FALSE = {
    "psi twice as large": scaled(brownian(), 2),
    "m smaller": brownian(shortfall="0.999999999"),
    "c smaller": brownian(supremum="2.401499999"),
    "more noise": with_plant(brownian(), diffusion=((R(11, 10),),)),
    "the disk with m smaller by 1e-6": disk(shortfall="0.079999", supremum="1.000001"),
    "the disk with a smaller m": disk(shortfall="0.079999999"),
    "psi above 0 on the edge": in_line(["0.01", "3.1", "-1"], shortfall=2, supremum="2.5"),
    "a bad policy": with_plant(disk(), policy=(R(10),)),
    "a policy beyond the bounds": with_plant(
        in_line(["-0.01", "2", "-1"], drift=3, h=x, shortfall="1.01", supremum="1.1"),
        input_matrix=((R(1),),),
        policy=(R(-3),),
    ),
    "a wider workspace": in_line(["1", "-0.1"], drift=-x, h=11 - x, ends=(-20, 4), supremum=2),
    "psi above 0 at the ends of a turn": in_line(
        ["10", "0", "-1"], drift=sp.sin(x), h=R(1), ends=(-sp.pi, sp.pi), shortfall=9, supremum=11
    ),
    "a pole": in_line(["-0.001", "3.1", "-1"], drift=1 / (x - 2), shortfall=100, supremum="2.5"),
    "a < 0": brownian(rate="-0.1"),
}

UNDECIDED = {
    "the disk without any room": disk(shortfall="0.08", supremum=1),
    "a pole that the input avoids": with_plant(brownian(), input_matrix=((1 / (x - 2),),)),
    "a policy with a pole, of an input that does nothing": with_plant(
        brownian(), policy=(1 / (x - 2),)
    ),
    "a root of a negative number": with_plant(brownian(), input_matrix=((sp.sqrt(x - 1),),)),
    "no value, but a bounded one": with_plant(brownian(), input_matrix=((sp.sin(1 / (x - 2)),),)),
    "true without any room on a line": disk(
        {(2, 0): F(-1), (1, 0): F(1)}, shortfall="100", supremum="0.25"
    ),
}
