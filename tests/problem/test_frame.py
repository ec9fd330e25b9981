"""A frame is used where the law of a step closes in its coordinates, and nowhere else."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, SystemDefinitionError, define_problem
from safe_envs.problem.frame import Frame
from safe_envs.problem.signals import Variable
from safe_envs.registry import make_problem
from safe_envs.values.reduction import reduced

x, y, p, u, r, k, q, s_1, s_2 = sp.symbols("x y p u r k q s_1 s_2", real=True)
TURNING = Frame((Variable(r, 0.0, 2.0, "m"),), (sp.sqrt(x**2 + y**2),), (r, sp.Integer(0)))
LINE = Frame((Variable(q, -1.5, 1.5),), (x,), (q, sp.Integer(0)))


def disk(name: str = "StochasticDubins", **options):
    return make_problem(f"safe_envs/{name}-v0", **options)


def turning(speed, noise: float = 0.05, half_width: float = 2.0, barriers=1 - x**2 - y**2, **rest):
    """Return a point that is driven around the origin, and outwards by the input."""
    system = ControlAffineSDE.from_rate(
        (x, y),
        (u,),
        [u * x - speed * y, u * y + speed * x],
        [[s_1, 0], [0, s_2]],
        {s_1: noise, s_2: noise},
    )
    given = {"frame": TURNING, "dt": 0.1, "horizon": 1.0, "input_bounds": (-1.0, 1.0), **rest}
    workspace = dict.fromkeys((x, y), (-half_width, half_width))
    return define_problem(system, barriers, start=[0.5, 0.0], workspace=workspace, **given)


def names(problem, **given):
    return tuple(map(str, reduced(problem, **given).symbols))


def test_a_vehicle_in_a_disk_has_two_coordinates():
    for name in ("DubinsDisk", "StochasticDubins"):
        found = reduced(disk(name))
        assert tuple(map(str, found.symbols)) == ("distance", "phi")
        assert [c.period for c in found.coordinates] == [0.0, 2 * math.pi]
        radius = disk(name).states[0].high
        assert (found.coordinates[0].low, found.coordinates[0].high) == (0.0, radius)
        assert (found.coordinates[1].low, found.coordinates[1].high) == (-math.pi, math.pi)
        assert found.outside == -1
        assert found.note == ""
    for options in ({"noise": 3.0}, {"noise": 0.01}, {"substeps": 5}):
        assert names(disk(**options)) == ("distance", "phi"), options
    assert names(disk("DubinsDisk"), intervals={"v": (0.8, 2.4)}) == ("distance", "phi")


def test_unequal_noises_are_refused():
    for noise in ((0.2, 0.1), (0.2, 0.2001), (0.2, 0.0)):
        found = reduced(disk(noise=noise))
        assert tuple(map(str, found.symbols)) == ("x", "y", "theta")
        assert "the law of" in found.note
        assert found.coordinates[2].period == 2 * math.pi
    # One uncertain level is another one than the level that is not, two are unlike each other.
    for intervals in ({"sigma_1": (0.1, 0.3)}, {"sigma_1": (0.1, 0.3), "sigma_2": (0.1, 0.3)}):
        assert names(disk(), intervals=intervals) == ("x", "y", "theta")
    # The model's noise counts where its step is taken.
    unlike = disk(model={"sigma_1": 0.3})
    assert names(unlike) == ("distance", "phi")
    assert names(unlike, knowledge="model") == ("x", "y", "theta")


def test_what_closes_in_continuous_time_only_is_refused():
    # The generator of any function of the distance is one of the distance, at any speed. An Euler
    # step from distance 1 ends at sqrt(1 + (h speed)^2), 1.044 or 1.015 here.
    angle = x / sp.sqrt(x**2 + y**2)
    assert names(turning(2.4)) == ("r",)
    found = reduced(turning(2.4 + 0.6 * angle))
    assert tuple(map(str, found.symbols)) == ("x", "y")
    assert found.note.startswith("the frame of problem is not used: the law of r after a step")
    # Without noise the simulation takes other steps, and the fourth order hides less than 1e-9.
    assert names(turning(2.4, noise=0.0)) == ("r",)
    assert names(turning(2.4 + 0.6 * angle, noise=0.0)) == ("x", "y")


def test_a_period_is_one_of_the_law():
    own = disk()
    distance, phi = own.frame.coordinates
    degrees = tuple(e * 180 / sp.pi for e in (own.frame.values[1], 1))
    for half, used in ((180.0, True), (math.pi, False)):
        frame = replace(
            own.frame,
            coordinates=(distance, Variable(phi.symbol, -half, half, "deg")),
            values=(own.frame.values[0], degrees[0]),
            section=(distance.symbol, sp.Integer(0), phi.symbol / degrees[1]),
            periods=(0.0, 2 * half),
        )
        assert ("law" in reduced(replace(own, frame=frame)).note) is not used


def test_barriers_and_goals_that_are_no_functions_of_the_coordinates_are_refused():
    for problem in (
        turning(2.4, barriers=1 - x**2 - 2 * y**2),
        turning(2.4, goal=x - 0.9),
        turning(2.4, barriers=[1 - x**2 - y**2, x + 5]),
    ):
        found = reduced(problem)
        assert tuple(map(str, found.symbols)) == ("x", "y")
        assert "barrier, goal or a region differ" in found.note
    found = reduced(turning(2.4, goal=x**2 + y**2 - sp.Rational(81, 100)))
    assert found.goal == r**2 - sp.Rational(81, 100)
    assert found.barriers == (1 - r**2,)


def test_a_workspace_that_cuts_safe_states_must_be_a_function_of_the_coordinates():
    found = reduced(turning(2.4, half_width=0.9))
    assert tuple(map(str, found.symbols)) == ("x", "y")
    assert "workspace" in found.note
    # A second state that nothing depends on, and safe states without end.
    system = ControlAffineSDE.from_rate((x, y), (u,), [u - x, sp.cos(y)], [k, 0], {k: 0.1})
    numbers = {"input_bounds": (-1.0, 1.0), "dt": 0.1, "horizon": 1.0, "start": [0.5, (0, 1)]}
    problem = define_problem(system, 1 + x, workspace={x: (-1.5, 1.5)}, frame=LINE, **numbers)
    found = reduced(problem)
    assert found.symbols == (q,)
    assert found.outside == sp.Abs(q) - 1.5
    bounded = {x: (-1.5, 1.5), y: (-1.0, 1.0)}
    both = reduced(define_problem(system, 1 + x, workspace=bounded, frame=LINE, **numbers))
    assert both.symbols == (x, y)
    assert "workspace" in both.note


def test_a_range_that_leaves_out_safe_states_is_refused():
    short = replace(TURNING, coordinates=(Variable(r, 0.0, 0.7),))
    found = reduced(turning(2.4, frame=short))
    assert found.symbols == (x, y)
    assert "r outside [0, 0.7]" in found.note


def test_a_section_with_other_coordinates_is_refused():
    wrong = replace(TURNING, section=(2 * r, sp.Integer(0)))
    assert "the section has another r" in reduced(turning(2.4, frame=wrong)).note


def test_laws_that_quadratures_cannot_resolve_are_refused():
    # Eight channels leave three nodes for each, which is too few to be sure of anything.
    problem = turning(2.4)
    four = [[s_1 / 2] * 4 + [0] * 4, [0] * 4 + [s_2 / 2] * 4]
    spread_out = replace(problem.plant, diffusion=four)
    found = reduced(replace(problem, plant=spread_out, model=spread_out))
    assert found.symbols == (x, y)
    assert "could not be computed" in found.note


def test_a_state_that_stands_for_itself_is_a_coordinate_or_known():
    rate = [u * x - y, u * y + x, 1]
    system = ControlAffineSDE.from_rate(
        (x, y, p), (u,), rate, [[s_1], [s_2], [0]], {s_1: 0, s_2: 0}
    )
    radius = 1 + sp.sin(p) / 5
    frame = replace(TURNING, section=(r, sp.Integer(0), p))
    numbers = {"input_bounds": (-1.0, 1.0), "dt": 0.1, "horizon": 1.0, "frame": frame}
    numbers["workspace"] = dict.fromkeys((x, y), (-2.0, 2.0))
    h = radius**2 - x**2 - y**2
    known = reduced(define_problem(system, h, start=[0.5, 0.0, 0.3], **numbers))
    assert known.symbols == (r,)
    np.testing.assert_allclose(known.known[p], 0.3 + 0.1 * np.arange(11))
    assert known.barriers[0].free_symbols == {r, p}
    drawn = reduced(define_problem(system, h, start=[0.5, 0.0, (0.0, 1.0)], **numbers))
    assert drawn.symbols == (r, p)
    assert [c.period for c in drawn.coordinates] == [0.0, 2 * math.pi]
    assert drawn.of_states((3.0, 4.0, 7.0)) == (5.0, 7.0)
    # Where its own bounds cut safe states, they are kept.
    numbers["workspace"][p] = (-1.0, 4.0)
    cut = reduced(define_problem(system, h, start=[0.5, 0.0, (0.0, 1.0)], **numbers))
    assert cut.symbols == (r, p)
    assert cut.outside == sp.Max(-p - 1.0, p - 4.0)
    del numbers["workspace"][p]
    # Its motion is compared as well: here the clock's rate depends on the angle.
    uneven = ControlAffineSDE.from_rate((x, y, p), (u,), [*rate[:2], 1 + x], parameters={})
    found = reduced(define_problem(uneven, h, start=[0.5, 0.0, (0.0, 1.0)], **numbers))
    assert found.symbols == (x, y, p)
    assert "the law of p" in found.note


def test_a_frame_that_fails_is_named_where_there_are_too_many_states():
    more = sp.symbols("m_1:4", real=True)
    system = ControlAffineSDE.from_rate(
        (x, y, *more), (u,), [u * x - y, u * y + 2 * x, *(-m + x for m in more)]
    )
    problem = define_problem(
        system,
        1 - x**2 - y**2,
        start=[0.5, 0.0, (0, 1), (0, 1), (0, 1)],
        workspace=dict.fromkeys((x, y, *more), (-2.0, 2.0)),
        frame=replace(TURNING, section=(r, sp.Integer(0), *more)),
        input_bounds=(-1.0, 1.0),
        dt=0.1,
        horizon=1.0,
    )
    with pytest.raises(ValueError, match=r"5 coordinates \(x, y, .*the frame of problem"):
        reduced(problem)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"coordinates": ()}, "`Variable` for each"),
        ({"coordinates": (r,)}, "`Variable` for each"),
        ({"coordinates": (Variable(sp.Symbol("r"), 0.0, 2.0),)}, "declared real"),
        ({"coordinates": (Variable(r, 0.0, math.inf),)}, "finite range"),
        ({"coordinates": (Variable(r, 2.0, 0.0),)}, "finite range"),
        ({"coordinates": (Variable(r, 0, 2), Variable(r, 0, 2))}, "the same name"),
        ({"periods": (3.0,)}, "one period"),
        ({"periods": (0.0, 0.0)}, "2 periods"),
        ({"values": (x, y)}, "2 values"),
        ({"values": ("x",)}, "is a text"),
        # These do not fit the system.
        ({"section": (r,)}, "for each of the 2 states"),
        ({"values": (x + q,)}, "symbol q"),
        ({"section": (r, x)}, "symbol x"),
        ({"coordinates": (Variable(s_1, 0, 2),), "section": (s_1, sp.S.Zero)}, "named like"),
    ],
)
def test_frames_without_sense_are_refused(changes, message):
    with pytest.raises(SystemDefinitionError, match=message):
        turning(1.0, frame=replace(TURNING, **changes))
