"""Method `pre`: from one crossing's signals to the optimum of its posterior.

The posterior has one deep minimum and many shallow ones: with every element free, a bridge that is
put half a metre too far can be explained almost as well by other rigidities. So the search

1. finds truck and trajectory while the bridge may change only as a whole, with the data taken for
   far noisier than they are, and step by step less so;
2. walks along the road: for every place of the bridge its parameters are fitted with all else held
   to first order (all other columns are projected out of the rows), which costs little and leads
   downhill to the right place;
3. frees everything from the best place, and from the next best ones if that does not fit, unless
   it fits so badly that no place would.

Longer than other modules: the steps are one way, and every threshold that was measured stands above
the step that it decides.
"""

from collections.abc import Callable
from enum import Enum, auto
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing.posterior import (
    Problem,
    all_rows,
    belief_in_springs,
    covariance,
    data_rows,
    layout,
    noise_floor,
    points,
    precision_root,
    rigidity_spread,
)
from pre_core.crossing.preparation import (
    Inputs,
    levels_at,
    off_bridge,
    prepare,
    swing_sample,
    with_noise_at,
)
from pre_core.crossing.residuals import SWING_MODES
from pre_core.crossing.whitening import DOUBTED_OF_A_MISFIT, RESIDUALS, linear_springs
from pre_core.physics.bridge import FloatArray
from pre_core.search import levenberg_marquardt
from pre_core.search.levenberg_marquardt import Rows, minimised
from pre_core.search.loop import Ending, Report, Solution
from pre_core.unknowns import TORSION, F

_COARSE = ((300.0, 4), (100.0, 4), (30.0, 4))
"""Temperatures and the steps at each on the way to the truck, the bridge taken as a whole."""
_COARSE_ON_TWO_ROADS = (*_COARSE, (10.0, 4))
"""Where roads differ the search begins with their difference as noise, which is told anew after
every step: with the sensors' alone it would not find its way."""
NOISY, HOPELESS_NOISE = 2.0, 25.0
"""From so many times the declared power on, evenly in the body equations' rows, noise is taken for
what it is; above the second the sensor is another one, or broken."""
_PLAINLY_DIFFERS = 200.0
"""Mean square of white rows off the bridge after the coarse steps: of 100 drawn crossings of one
road 130 at most and mostly below 25, with twin tyres on the best class of road 200,000."""
_FREE = ((5.0, 8, 0.2), (1.0, 25, 0.1))
"""Temperatures (noise is taken for this many times what it is), the steps at each, and the gain in
the sum of squares that is not worth another step."""
_PLAINLY_RUBS = 0.05
"""A truck whose springs leave less of what the sensors could tell by the body equations is not
tried with springs believed: they plainly rub."""
_LOST_CHI2 = 10.0
"""With the noise taken for five times what it is, sound starts of 90 drawn crossings were at 1.6 at
most, wrong ones at 10 to 70."""
_MOST_ROUNDS, _ROUNDS_ON_THE_WAY = 6, 2
"""Fits and levels of noise that the rows tell take turns at most so often, on the way so often."""
_MOST_STEPS, _STEPS_ON_THE_WAY = 25, 8
"""Where the roads differ, and the noise is told anew before every step."""
_ENOUGH_ON_TWO_ROADS = 0.5
"""A gain in the sum of squares that is not worth another step there: what is left to find is far
within the width of what is hardly known."""
_SAME_LEVEL = 0.1
"""A level of noise that changes by less than this part is settled."""
_WALK_TEMPERATURE = 3.0
"""The temperature at which the walk along the road compares places: minima are wide there."""
_WALK_STEPS = 6
"""Steps at each place: only how good it is compared with the others is asked."""
_WALK_ENOUGH = 0.5
"""A gain in the sum of squares that is not worth another step there."""
_STRIDE_M = 0.6
"""Places that the walk along the road looks at are so far apart."""
_REFINED_M = (0.3, 0.15)
"""And so much closer about the best one."""
_BESIDE_M, _BESIDE = 0.1, 6
"""Where the roads differ so many places to either side of an optimum are looked at: a bearing that
gives makes minima 0.2 m apart, and what the walk knows of the truck tells not which is right."""
_PLAINLY_SPRUNG = 0.5
"""Scales of their prior from which on springs at the ends, bearings that give and torsion are
tried without."""
_MOST_MOVES = 4
"""From an optimum to one beside it."""
_PATIENCE = 1.5  # strides beyond the best place
_REACH = 3.0  # of the offset's spread
_APART_M = 0.2
"""Places closer to each other than this lead to one minimum."""
_ACCEPTED_Z, _ACCEPTED_EXCESS = 3.0, 0.05
"""A minimum is taken for the right one if chi2 is no further above one than chance (so many
standard deviations) and what the noise model leaves out explain."""

_EXCESS_ON_TWO_ROADS = 0.25
"""Where roads differ: how much by is read off a few waves, and chi2 is as uncertain as that."""
_HOPELESS_CHI2 = (1000.0, 25.0)
"""Above the first after one place is freed, above the second after more, no other place is tried.
Of 70 drawn sound crossings the first place was the right one in all; another one never brought a
chi2 of this size down to something usable."""
_MOST_EVALUATIONS = 100_000
"""Of a whole search. The sample takes 2,000, a site file with two supports too many 65,000: beyond
this a search has lost its way, and none of its numbers can be trusted."""
_MOST_STRIDES = 60
"""To either side on the walk along the road, however little is known of the offset."""
_BEND = 0.8
"""A little less than what would make the coordinate linear in 1/EI: see `bends`."""


class Way(NamedTuple):
    """What a search leaves out until the rest is right."""

    modes_at_rest: int
    """So many of the bridge's modes, the quickest, do not swing."""
    believes: bool
    """In the springs; it ends where they plainly rub."""
    most_places: int
    differs: bool
    """Whether the axles' roads differ, from the first step on; they may turn out not to."""


_SIMPLEST = Way(SWING_MODES, True, 1, False)
_ON_ONE_ROAD = (Way(SWING_MODES - 1, True, 4, False), Way(0, False, 4, False))
_ON_TWO_ROADS = (Way(SWING_MODES, True, 1, True), Way(0, False, 4, True))
"""The simplest way first, then the others one after the other until one ends at a fit: each freedom
that is not needed leads astray now and then. Of 40 drawn crossings and 36 with bearings, spans or
tyres that nobody expects the first way found all but one, which the second did. Ways on which the
roads differ come before the others where the rows off the bridge say so."""


Again = Callable[[Problem, FloatArray], Problem]
"""The problem with its noise for another point."""


class Optimum(NamedTuple):
    """Where the search ended; `chi2_per_dof` is of the data against the declared noise."""

    problem: Problem
    state: levenberg_marquardt.State
    ending: Ending
    chi2_per_dof: float
    evaluations: int
    starts: int
    """How many places along the road all unknowns were freed from."""
    rubs: bool = False
    """Whether a search that believed in springs was given up because they plainly rub."""
    differs: bool = False
    """Whether a search on one road was given up because the axles' roads plainly differ."""
    noise_power: float = 1.0
    """That of the sensors over what was declared, where it is plainly more: it looks like springs
    that rub and roads that differ. Up to `HOPELESS_NOISE` it was taken for what it is."""


def chi2_per_dof(problem: Problem, y: FloatArray) -> float:
    """Mean square of the white rows; each of the trajectory's and truck's unknowns takes one.

    Where springs are doubted, of the road's rows alone, which take their share of these: the others
    are silenced.
    """
    rows = data_rows(problem, y[None, :])[0, :: _every_judged(problem)]
    taken = y.size / _every_judged(problem)
    return float(rows @ rows) / max(1.0, rows.size - taken)


def _every_judged(problem: Problem) -> int:
    """How many white rows there are for each that chi2 is of."""
    return RESIDUALS if problem.force.any() else 1


def _tempered(problem: Problem, y: FloatArray, directions: FloatArray, temperature: float) -> Rows:
    return lambda v: all_rows(problem, y + v @ directions.T, temperature)


def _descend(
    problem: Problem,
    y: FloatArray,
    directions: FloatArray,
    temperature: float,
    steps: int,
    enough: float,
    is_free: bool = False,
) -> tuple[FloatArray, levenberg_marquardt.State, Ending, int]:
    """Least squares along `directions` (f, d) from y; `enough` is a gain not worth a step."""
    rows = _tempered(problem, y, directions, temperature)
    start = np.zeros(directions.shape[1])
    lower = _lower(problem, y, directions, is_free=is_free)
    found = minimised(rows, start, steps, enough, lower, is_followed=is_free)
    return y + directions @ found.state.y, found.state, found.ending, _evaluations(found)


def _lower(problem: Problem, y: FloatArray, directions: FloatArray, *, is_free: bool) -> FloatArray:
    """How far back along each of the directions (f, d) nothing becomes negative that must not.

    What must not changes along one direction each. On the way (`is_free`) springs may push and
    dampers drive, which leads through where they would be stuck at nothing; a bearing may not rise,
    nor a deck twist against its load.
    """
    lower = np.full(directions.shape[1], -np.inf)
    held = layout(problem).half_normal
    if is_free:
        kept = np.flatnonzero(problem.priors.estimated)
        held = held[np.isin(kept[held], (F, F + 1, TORSION))]
    for place in held:
        for along in np.flatnonzero(directions[place]):
            lower[along] = -y[place] / directions[place, along]
    return lower


def _evaluations(found: Solution[levenberg_marquardt.State, levenberg_marquardt.Info]) -> int:
    """How many a search with forward differences took, its first Jacobian included."""
    return found.state.y.size + 1 + sum(info.evaluations for info in found.infos)


def _whole_bridge(problem: Problem, way: Way) -> FloatArray:
    """Directions in which all elements change alike, without springs and bearings that give."""
    where = layout(problem)
    unit = np.eye(where.size)
    elements = where.elements
    ends = where.half_normal[where.half_normal >= where.bridge[0]]
    held = [*elements, *ends, *_at_rest(problem, way)]
    single = np.setdiff1d(np.arange(where.size), held)
    together = unit[:, elements].sum(axis=1) / np.sqrt(elements.size)
    return np.column_stack([unit[:, single], together])


def _at_rest(problem: Problem, way: Way) -> NDArray[np.int64]:
    """Places in y of the modes that do not swing."""
    swing = layout(problem).swing
    return np.arange(swing.stop - 2 * way.modes_at_rest, swing.stop)


def _not_negative(problem: Problem, y: FloatArray) -> FloatArray:
    """y with what must not be negative at nothing at least."""
    zero = layout(problem).half_normal
    y = y.copy()
    y[zero] = np.maximum(y[zero], 0.0)
    return y


class _Place(NamedTuple):
    """How well the bridge, put `shift_m` further along the road, fits; its unknowns there."""

    objective: float
    shift_m: float
    bridge: FloatArray
    places: NDArray[np.int64]
    """Where in y these unknowns are."""


Look = Callable[[float, FloatArray], tuple[_Place, int]]
"""From a shift in m and the bridge's unknowns there to start with, to the place and evaluations."""


def _looking(problem: Problem, y: FloatArray, way: Way) -> Look:
    """Fits the bridge alone at places along the road, all else held to first order about y."""
    where = layout(problem)
    places = where.bridge
    free = np.eye(y.size)
    here = levenberg_marquardt.begin(
        _tempered(problem, y, free, _WALK_TEMPERATURE), np.zeros(y.size)
    ).jacobian
    held = np.union1d(places, _at_rest(problem, way))
    others, _ = np.linalg.qr(np.delete(here, held, axis=1))

    def look(shift: float, start: FloatArray) -> tuple[_Place, int]:
        moved = y.copy()
        moved[where.trajectory] += shift
        rows = _tempered(problem, moved, free[:, places], _WALK_TEMPERATURE)

        def projected(v: FloatArray) -> FloatArray:
            values = rows(v)
            return np.asarray(values - (values @ others) @ others.T)

        lower = _lower(problem, moved, free[:, places], is_free=True)
        found = minimised(projected, start, _WALK_STEPS, _WALK_ENOUGH, lower, is_followed=True)
        place = _Place(found.state.objective, shift, found.state.y, places)
        return place, _evaluations(found)

    return look


def _walk(problem: Problem, y: FloatArray, way: Way) -> tuple[list[_Place], int]:
    """Places along the road, best first, and the evaluations that they took."""
    looking = _looking(problem, y, way)
    nothing = np.zeros(layout(problem).bridge.size)
    evaluations = y.size + 1
    seen: list[_Place] = []

    def look(shift: float, start: FloatArray) -> None:
        nonlocal evaluations
        place, used = looking(shift, start)
        evaluations += used
        if np.isfinite(place.objective):
            seen.append(place)

    def best() -> _Place:
        return min(seen, key=lambda place: place.objective)

    look(0.0, nothing)
    reach = min(_STRIDE_M + _REACH / problem.receiver_rows[-1, -1], _MOST_STRIDES * _STRIDE_M)
    for sign in (1.0, -1.0):
        shift = sign * _STRIDE_M
        while abs(shift) <= reach:
            look(shift, nothing)
            if seen and sign * (shift - best().shift_m) > _PATIENCE * _STRIDE_M:
                break
            shift += sign * _STRIDE_M
    for stride in _REFINED_M if seen else ():
        centre = best()
        for sign in (1.0, -1.0):
            look(centre.shift_m + sign * stride, centre.bridge)
    return sorted(seen, key=lambda place: place.objective), evaluations


def _beside(found: Optimum, way: Way) -> tuple[_Place | None, int]:
    """The best place beside an optimum, if it fits better than that; and the evaluations."""
    y = found.state.y
    looking = _looking(found.problem, y, way)
    nothing = np.zeros(layout(found.problem).bridge.size)
    here, evaluations = looking(0.0, nothing)
    evaluations += y.size + 1
    best = here
    for number in range(-_BESIDE, _BESIDE + 1):
        if number:
            place, used = looking(_BESIDE_M * number, nothing)
            evaluations += used
            best = min(best, place, key=lambda one: one.objective)
    return (best if best.objective < here.objective - _WALK_ENOUGH else None), evaluations


def find_optimum(inputs: Inputs, report: Report = lambda stage, fraction: None) -> Optimum:
    """The optimum of the posterior. Its `ending` is NOT_FINITE if no place gave finite rows.

    It is STEPS_EXHAUSTED if the search took more than `_MOST_EVALUATIONS` and found no fit.
    """
    problem, y = prepare(inputs)
    found = [_from_places(problem, y, _SIMPLEST, report, _MOST_EVALUATIONS)]
    if not _is_final(found[0]):
        found += _further(problem, y, found[0], report)
    best = min(found, key=lambda one: (one.noise_power <= HOPELESS_NOISE, one.chi2_per_dof))
    evaluations = sum(one.evaluations for one in found)
    is_lost = evaluations > _MOST_EVALUATIONS and not _is_final(best)
    if is_lost and best.ending is not Ending.NOT_FINITE:
        best = best._replace(ending=Ending.STEPS_EXHAUSTED)
    return best._replace(evaluations=evaluations, starts=sum(one.starts for one in found))


def _further(problem: Problem, y: FloatArray, first: Optimum, report: Report) -> list[Optimum]:
    """What the other ways led to, up to the first that is final."""
    differs = first.differs
    if first.ending is not Ending.NOT_FINITE:
        differs = bool(levels_at(first.problem, first.state.y).any())
    believing, doubting = _ON_ONE_ROAD
    ways = (*_ON_ONE_ROAD, *_ON_TWO_ROADS)
    if differs:
        ways = (_ON_TWO_ROADS[0], doubting, _ON_TWO_ROADS[1], believing)
    found: list[Optimum] = []
    rubs = first.rubs
    for way in ways:
        # Springs that rub look like roads that differ until they are doubted.
        if rubs if way.believes else (way == doubting and differs and not rubs):
            continue
        left = _MOST_EVALUATIONS - sum(one.evaluations for one in (first, *found))
        if left <= 0:
            break
        found.append(_from_places(problem, y, way, report, left))
        rubs = found[-1].rubs
        if _is_final(found[-1]):
            break
    return found


def _is_final(found: Optimum) -> bool:
    """Whether no other way is worth a try: this is a fit, or nothing will be."""
    is_hopeless = found.noise_power > HOPELESS_NOISE
    return is_hopeless or _is_accepted(found.problem, found.chi2_per_dof)


def _is_accepted(problem: Problem, chi2: float) -> bool:
    """Whether a minimum of this chi2 is taken for the right one."""
    judged = problem.noise.reciprocal.size // _every_judged(problem)
    excess = _EXCESS_ON_TWO_ROADS if problem.mismatch.level_m3.any() else _ACCEPTED_EXCESS
    return chi2 < 1.0 + excess + _ACCEPTED_Z * float(np.sqrt(2.0 / judged))


def _from_places(problem: Problem, y: FloatArray, way: Way, report: Report, most: int) -> Optimum:
    """Return the best optimum of a way; none, as at numbers beyond all bounds, if it runs away."""
    try:
        return _from_likeliest_places(problem, y, way, report, most)
    except (FloatingPointError, np.linalg.LinAlgError):
        return _nowhere(problem, y, 0, 0)


def _from_likeliest_places(
    problem: Problem, y: FloatArray, way: Way, report: Report, most: int
) -> Optimum:
    """The best optimum of those that are reached from the likeliest places along the road.

    None, as if no place gave finite rows, as soon as a place shows that the way is wrong. After
    `most` evaluations no other place is tried.
    """
    force = linear_springs() if way.believes else None
    whole = _whole_bridge(problem, way)

    def with_force(problem: Problem, y: FloatArray) -> Problem:
        return with_noise_at(problem, y, force)

    evaluations = 0
    if way.differs:
        problem = with_noise_at(problem, y, force, mismatch=levels_at(problem, y))
    for temperature, steps in _COARSE_ON_TWO_ROADS if way.differs else _COARSE:
        report("finding the truck", 0.05)
        problem, y, _, used = _searched(problem, y, whole, (temperature, steps, 0.5), with_force)
        evaluations += used
        problem = with_noise_at(problem, y, force)
    power = noise_floor(problem, y)
    if power > HOPELESS_NOISE:
        return _nowhere(problem, y, evaluations, 0)._replace(noise_power=power)
    if power > NOISY:
        problem = problem._replace(density=problem.density * np.sqrt(power))
        problem = with_noise_at(problem, y, force)
    else:
        power = 1.0
    if not way.differs and _plainly_differs(problem, y):
        return _nowhere(problem, y, evaluations, 0, differs=True)
    report("finding the bridge", 0.2)
    places, used = _walk(problem, y, way)
    evaluations += used
    best: Optimum | None = None
    rubs = False
    tried: list[float] = []
    for place in places:
        if any(abs(place.shift_m - other) < _APART_M for other in tried):
            continue
        tried.append(place.shift_m)
        report(f"freeing the elements, start {len(tried)}", 0.3 + 0.05 * len(tried))
        found, used = _freed(problem, _moved(problem, y, place), way)
        evaluations += used
        if isinstance(found, Optimum) and found.problem.mismatch.level_m3.any():
            found, used = _settled(found, way, most - evaluations)
            evaluations += used
        if not isinstance(found, Optimum):
            rubs = found is _Wrong.RUBS
            break
        if best is None or found.chi2_per_dof < best.chi2_per_dof:
            best = found
        if _is_accepted(best.problem, best.chi2_per_dof) or len(tried) == way.most_places:
            break
        if best.chi2_per_dof > _HOPELESS_CHI2[min(len(tried), len(_HOPELESS_CHI2)) - 1]:
            break
        if evaluations > most:
            break
    if best is None:
        return _nowhere(problem, y, evaluations, len(tried), rubs=rubs)
    best, used = _with_free_ends(best, way)
    evaluations += used
    return best._replace(
        evaluations=evaluations,
        starts=len(tried),
        rubs=rubs,
        noise_power=power * _left_noise(best),
    )


def _moved(problem: Problem, y: FloatArray, place: _Place) -> FloatArray:
    """y with the bridge put where a place is."""
    moved = y.copy()
    moved[layout(problem).trajectory] += place.shift_m
    moved[place.places] += place.bridge
    return moved


def _with_free_ends(found: Optimum, way: Way) -> tuple[Optimum, int]:
    """Return the better of an optimum with springs at the ends and one without, and evaluations.

    A bridge that is held at both ends and has less than half its stiffness bends nearly as one on
    free bearings, with a truck that is wrong by a third of its prior: a search that is led there
    stays there.
    """
    where, y = layout(found.problem), found.state.y
    ends = np.intersect1d(where.half_normal, where.bridge)
    if not np.any(y[ends] > _PLAINLY_SPRUNG):
        return found, 0
    start = y.copy()
    start[where.bridge] = 0.0
    other, used = _freed(found.problem, start, way)
    if isinstance(other, Optimum) and other.chi2_per_dof < found.chi2_per_dof:
        found = other
    return found, used


def _settled(found: Optimum, way: Way, most: int) -> tuple[Optimum, int]:
    """The best of an optimum and those beside it on a road that differs, and the evaluations."""
    evaluations = 0
    for _ in range(_MOST_MOVES):
        if evaluations > most:
            break
        place, used = _beside(found, way)
        evaluations += used
        if place is None:
            break
        other, used = _freed(found.problem, _moved(found.problem, found.state.y, place), way)
        evaluations += used
        if not isinstance(other, Optimum) or other.chi2_per_dof >= found.chi2_per_dof:
            break
        found = other
    return found, evaluations


def _left_noise(found: Optimum) -> float:
    """What `noise_floor` still says at an optimum, 1 if that is not plain."""
    power = noise_floor(found.problem, found.state.y)
    return power if power > NOISY else 1.0


def _nowhere(
    problem: Problem,
    y: FloatArray,
    evaluations: int,
    starts: int,
    *,
    rubs: bool = False,
    differs: bool = False,
) -> Optimum:
    """What a search is that ended without an optimum."""
    state = levenberg_marquardt.begin(lambda at: all_rows(problem, at), y)
    ending = Ending.NOT_FINITE
    return Optimum(problem, state, ending, np.inf, evaluations, starts, rubs, differs)


def _plainly_differs(problem: Problem, y: FloatArray) -> bool:
    """Whether rows off the bridge are beyond what coarse steps leave of one road."""
    rows = data_rows(problem, y[None, :])[0].reshape(-1, RESIDUALS)[:, 0]
    off = np.concatenate([rows[one] for one in off_bridge(problem, y)])
    return off.size > 0 and float(off @ off) / off.size > _PLAINLY_DIFFERS


class _Wrong(Enum):
    """Why there is no optimum on a way that believes in springs."""

    RUBS = auto()
    LOST = auto()


def _freed(problem: Problem, y: FloatArray, way: Way) -> tuple[Optimum | _Wrong, int]:
    """Least squares in all unknowns, and its evaluations; supports do not push, no damping drives.

    What would be negative is held at zero, and the rest brought to the optimum beside it. The slope
    that is left there belongs to the normal approximation (`normal_approximation`).

    What the springs leave over and how much they are believed depend on each other: a truck that is
    not believed need not fit. So it is believed at first, and doubted only where the body equations
    then leave more than the sensors' noise. There is no optimum on a way that believed in springs
    that plainly rub, or that is lost.
    """

    def believed(problem: Problem, y: FloatArray) -> Problem:
        return with_noise_at(problem, y, linear_springs())

    def doubted(problem: Problem, y: FloatArray) -> Problem:
        return with_noise_at(problem, y, doubted=DOUBTED_OF_A_MISFIT)

    front = points(problem, y[None, :]).position_m[0]
    crossing = problem.crossing
    problem = problem._replace(
        crossing=crossing._replace(swing_sample=swing_sample(crossing, front))
    )
    start = y.copy()
    start[layout(problem).swing] = 0.0
    free = np.eye(start.size)
    first = np.delete(free, _at_rest(problem, way), axis=1)
    believing = with_noise_at(problem, start, linear_springs())
    believing, y, ending, evaluations = _searched(believing, start, first, _FREE[0], believed)
    believing = with_noise_at(believing, y, linear_springs())
    problem = with_noise_at(believing, y)
    rubs = problem.force.any() and belief_in_springs(problem, y) < _PLAINLY_RUBS
    if way.believes and rubs:
        return _Wrong.RUBS, evaluations
    if way.believes and chi2_per_dof(believing, y) > _LOST_CHI2:
        return _Wrong.LOST, evaluations
    if rubs:
        problem = with_noise_at(believing, start)
        problem, y, ending, used = _searched(problem, start, free, _FREE[0], with_noise_at)
        evaluations += used
    else:
        for is_free, rounds in ((True, _ROUNDS_ON_THE_WAY), (False, _MOST_ROUNDS)):
            y = y if is_free else _not_negative(problem, y)
            problem = with_noise_at(problem, y, linear_springs())
            problem, y, ending, used = _in_rounds(
                problem, y, first if is_free else free, rounds, believed, is_free=is_free
            )
            evaluations += used
    problem = with_noise_at(problem, y)
    y = _not_negative(problem, y)
    if not (problem.force.any() or _is_accepted(problem, chi2_per_dof(problem, y))):
        problem = with_noise_at(problem, y, doubted=DOUBTED_OF_A_MISFIT)
    if problem.force.any():
        problem, y, ending, used = _in_rounds(problem, y, free, _MOST_ROUNDS, doubted)
        evaluations += used
    state = levenberg_marquardt.begin(lambda at: all_rows(problem, at), y)
    found = Optimum(problem, state, ending, chi2_per_dof(problem, y), evaluations, 1)
    return found, evaluations + y.size + 1


def _in_rounds(
    problem: Problem,
    y: FloatArray,
    directions: FloatArray,
    rounds: int,
    again: Again,
    *,
    is_free: bool = False,
) -> tuple[Problem, FloatArray, Ending, int]:
    """Least squares from y, until the noise that rows tell stays as it is.

    `again` gives the problem with its noise for another y: where the roads are one, after a fit, in
    `rounds` at most; where they differ, before every step (`_followed`).
    """
    temperature, steps, enough = _FREE[-1]
    evaluations = 0
    if problem.mismatch.level_m3.any():
        most = _STEPS_ON_THE_WAY if is_free else _MOST_STEPS
        problem, y, ending, evaluations = _followed(
            problem, y, directions, temperature, most, again, is_free=is_free
        )
        if problem.mismatch.level_m3.any():
            return problem, y, ending, evaluations
    for _ in range(rounds):
        y, _, ending, used = _descend(
            problem, y, directions, temperature, steps, enough, is_free=is_free
        )
        evaluations += used
        if not problem.force.any():
            break
        before, problem = problem, again(problem, y)
        if abs(before.force.sum() - problem.force.sum()) <= _SAME_LEVEL * before.force.sum():
            break
    return problem, y, ending, evaluations


def _searched(
    problem: Problem,
    y: FloatArray,
    directions: FloatArray,
    how: tuple[float, int, float],
    again: Again,
) -> tuple[Problem, FloatArray, Ending, int]:
    """Least squares on the way: `how` is temperature, steps, and the gain not worth a step.

    Where the roads differ the noise is told anew by `again` before every step.
    """
    temperature, steps, enough = how
    if problem.mismatch.level_m3.any():
        return _followed(problem, y, directions, temperature, steps, again, is_free=True)
    y, _, ending, used = _descend(problem, y, directions, temperature, steps, enough, is_free=True)
    return problem, y, ending, used


def _followed(
    problem: Problem,
    y: FloatArray,
    directions: FloatArray,
    temperature: float,
    steps: int,
    again: Again,
    *,
    is_free: bool = False,
) -> tuple[Problem, FloatArray, Ending, int]:
    """Steps along `directions` (f, d) from y, the noise told anew before each of them.

    What is taken off the slope for the roads' mismatch (errors in variables) is as large as what
    the rows themselves say of a truck whose springs rub, and belongs to the truck at which it was
    computed: along a valley of loads, axle masses and tyres that leave the roads as they are it
    turns with the valley. Held for a few steps, it led a third of such trucks away without end;
    followed step by step it ends at the right one, from the data sheet's on.
    """
    evaluations = 0
    ending = Ending.STEPS_EXHAUSTED
    damping: float | None = None
    last, share = np.zeros(1), 1.0
    for _ in range(steps):
        problem = again(problem, y)
        rows = _tempered(problem, y, directions, temperature)
        here = levenberg_marquardt.begin(rows, np.zeros(directions.shape[1]))
        if damping is not None:
            here = here._replace(damping=damping)
        there = levenberg_marquardt.move(
            rows, here, _lower(problem, y, directions, is_free=is_free)
        )
        evaluations += here.y.size + 1
        if not isinstance(there, levenberg_marquardt.Move):
            ending = there[1].ending or ending
            evaluations += there[1].evaluations
            if ending is Ending.STUCK:
                ending = Ending.CONVERGED
            break
        evaluations += there.evaluations
        # A step that leads back went beyond the place that it seeks, which moves with the noise.
        step = here.jacobian @ there.y
        share = 0.5 * share if float(np.sum(step * last)) < 0.0 else min(1.0, 2.0 * share)
        y = y + share * (directions @ there.y)
        last, damping = step, there.damping
        if here.objective - there.objective < _ENOUGH_ON_TWO_ROADS:
            ending = Ending.CONVERGED
            break
    return problem, y, ending, evaluations


def bends(problem: Problem) -> FloatArray:
    """How much each coordinate is to be bent for the draws (`approximation`): those of ln EI are.

    The deflection of a statically determinate beam is linear in 1/EI; a little less, for the prior
    is normal in ln EI.
    """
    where = layout(problem)
    bend = np.zeros(where.size)
    bend[where.elements] = _BEND * rigidity_spread(problem.priors)
    return bend


def normal_approximation(found: Optimum) -> tuple[FloatArray, FloatArray]:
    """Mean (f,) and covariance (f, f) of the Gauss-Newton approximation at the optimum."""
    spread = covariance(precision_root(found.state.jacobian))
    slope = found.state.jacobian.T @ found.state.residual
    return found.state.y - spread @ slope, spread
