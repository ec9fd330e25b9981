/* The core of a safety filter, the same in every exported one: its quadratic program, and decide().
 *
 * What is included before it defines
 *
 *     real                 double, or float where SINGLE_PRECISION is 1
 *     CONSTRAINTS, INPUTS  how many there are
 *     GOAL                 1 where the filter pursues a goal of its own, else 0
 *     RECIPROCAL           constraints that demand more in a domain
 *     SAMPLED              constraints that are to hold all along the control period
 *     UNCERTAIN            constraints that are known up to an error
 *     MAXIMA               constraints of barriers that are maxima
 *     PARTIAL              constraints of barriers that may have no value
 *     DOMAINS, FUNCTIONS   positive expressions of all domains, and functions of all maxima
 *     UNITS                most units of a learned network, 0 without one
 *
 * and the constants `kinds`, `input_weight`, `slack_weight`, `period` and `goal_unit`. Nothing is
 * allocated, nothing is kept between calls, and all loops are bounded.
 */
#ifdef CONSTRAINTS

#if SINGLE_PRECISION
#define EPSILON 1.1920929e-7F
#define LARGEST 3.4028235e38F
#define SMALL_SQUARE 1.1754944e-38F
#define LARGE_SQUARE 1e18F
#define COARSER 536870912.0F /* times that float is coarser than double */
#define ABS fabsf
#define SQRT sqrtf
#define FMOD fmodf
#define TANH tanhf
#else
#define EPSILON 2.220446049250313e-16
#define LARGEST 1.7976931348623157e308
#define SMALL_SQUARE 1e-200
#define LARGE_SQUARE 1e200
#define COARSER 1.0
#define ABS fabs
#define SQRT sqrt
#define FMOD fmod
#define TANH tanh
#endif

/* Part of a constraint's terms that is rounding: a sum of n products is off by n epsilons. */
#define ROUNDING ((real)16 * EPSILON)
/* Between SMALL_SQUARE and LARGE_SQUARE, squares neither vanish nor overflow. */
/* Widths of the bounds from which on a proposal drowns the input in its rounding. */
#define FAR_OFF ((real)1e3)
/* Steps for each constraint and input: many times more than were ever needed. */
#define STEPS 20
/* Steps that take back the rounding of a long one. */
#define CORRECTIONS 4
/* Part of a vector that remains, by rounding, of one that depends on others. */
#define DEPENDENT ((real)1e-14 * COARSER)
/* Part of the forces of slacks on an input that is rounding. */
#define NO_FORCE ((real)1e-12 * COARSER)
/* Part of a step, or of the distance to the proposal, that is rounding. */
#define NO_DISTANCE ((real)1e-13 * COARSER)
/* Tolerances from which on a margin is no rounding, nor are the forces that come of it. */
#define SURELY ((real)1e3)
/* More than are needed to separate any two numbers by half steps. */
#define BISECTIONS 200
/* How many times further than the bounds reach is far away. */
#define FAR_AWAY ((real)1e4)
/* Share of its terms without input by which a constraint exceeds 0 at the end of the period. */
#define INWARDS ((real)1e-8)
/* Rounds of Newton's method in which an input is moved to where constraints hold for a period. */
#define ROUNDS 12
/* No point of a line is further away; it is a number in single precision as well. */
#define FAR_ON_LINE ((real)1e37)
/* Share of the squared violations that is left by a step that helps, */
#define BETTER ((real)0.999999999)
/* by a round after which another one is tried, */
#define ENOUGH ((real)0.9)
/* and by a step after which lines along each input are tried. */
#define SLOW ((real)0.25)
/* Where on a line a constraint changes; see `point_of_change`. */
#define POINTS 5

#define ROWS (CONSTRAINTS + GOAL + SAMPLED)
#define COLUMNS (INPUTS + GOAL)
#define ONE_INPUT (INPUTS == 1 && (!GOAL || SAMPLED))
#define SEVERAL (ROWS > 1 && COLUMNS > 1)
#define MOST_VECTORS COLUMNS
#define MOST_ENTRIES (ROWS > COLUMNS ? ROWS : COLUMNS)
#define INTERVALS (UNCERTAIN > 0 && INPUTS == 1 && !GOAL)
#define FORM ((INPUTS + 1) * (INPUTS + 2) / 2)
#define HELD (CONSTRAINTS + SAMPLED) /* rows of a period */
#define LINE (1 + INPUTS + INPUTS * (INPUTS + 1) / 2)
/* Only margins count where there is nothing but one constraint. */
#define ONLY_ONE \
    (CONSTRAINTS == 1 && !(GOAL || RECIPROCAL || SAMPLED || UNCERTAIN || MAXIMA || PARTIAL))

/* What is in the values of the constraints at a state, and where. */
#define OFFSETS (CONSTRAINTS * INPUTS)          /* after the coefficients, row by row */
#define GROWTH (OFFSETS + CONSTRAINTS)          /* of the goal, and its slopes along inputs */
#define LEVELS (GROWTH + GOAL * (INPUTS + 1))   /* what is positive in the domains */
#define HEIGHTS (LEVELS + DOMAINS)              /* barriers that may have no value */
#define FORMS (HEIGHTS + PARTIAL)               /* upper triangles of uncertainties */
#define VALUES (FORMS + UNCERTAIN * FORM)

/* Formulas of the problem, which follow the core. */
static void constraint_values(const real *x, real *values);
#if RECIPROCAL
static void demand_values(const real *x, real *demands);
#endif
#if SAMPLED
static void change_values(const real *x, real *changes);
#endif
#if MAXIMA
static void function_values(const real *x, real *functions);
#endif

#ifdef __GNUC__
#define HELPER static inline __attribute__((unused))
#else
#define HELPER static inline
#endif

/* Return the larger number; the first where they cannot be compared. */
HELPER real larger(real a, real b)
{
    return b > a ? b : a;
}

/* Return the smaller number; the first where they cannot be compared. */
HELPER real smaller(real a, real b)
{
    return b < a ? b : a;
}

HELPER real clip(real x, real low, real high)
{
    return x < low ? low : x > high ? high : x;
}

HELPER real positive_part(real x)
{
    return x > 0 ? x : 0;
}

/* Return the sum of numbers, which is finite only if all are. */
HELPER real sum_of(int n, const real *a)
{
    real total = 0;
    for (int j = 0; j < n; j++) {
        total += a[j];
    }
    return total;
}

/* Return the sum of products. */
HELPER real dot(int n, const real *a, const real *b)
{
    real total = 0;
    for (int j = 0; j < n; j++) {
        total += a[j] * b[j];
    }
    return total;
}

/* Return the largest size of numbers. */
HELPER real size_of(int n, const real *a)
{
    real size = 0;
    for (int j = 0; j < n; j++) {
        size = larger(size, ABS(a[j]));
    }
    return size;
}

/* Add a multiple of numbers to others. */
HELPER void add_multiple(int n, real factor, const real *a, real *to)
{
    for (int j = 0; j < n; j++) {
        to[j] += factor * a[j];
    }
}

/* For formulas: the larger number, or NaN where one is. */
HELPER real maximum(real a, real b)
{
    return a >= b || a != a ? a : b;
}

/* For formulas: the smaller number, or NaN where one is. */
HELPER real minimum(real a, real b)
{
    return a <= b || a != a ? a : b;
}

/* For formulas: -1, 0 or 1; NaN for NaN. */
HELPER real sign(real x)
{
    return x > 0 ? 1 : x < 0 ? -1 : x;
}

/* For formulas: a - b floor(a / b), which has the sign of b. */
HELPER real modulo(real a, real b)
{
    const real rest = FMOD(a, b);
    return rest != 0 && (rest < 0) != (b < 0) ? rest + b : rest;
}

/* Minimise 1/2 sum_j w_j (u_j - v_j)^2 subject to a_i . u + b_i >= 0 and low <= u <= high.
 *
 * Where the constraints cannot be met together, the answer is the nearest to v of the inputs that
 * minimise sum_i priority_i slack_i^2 with slack_i = max(0, -(a_i . u + b_i)). A constraint counts
 * as met where a_i . u + b_i >= -ROUNDING (|b_i| + sum_j |a_ij u_j|), whatever its units.
 */
typedef struct {
    int k;               /* constraints */
    int m;               /* inputs */
    const real *a;       /* k rows of m coefficients */
    const real *b;       /* k offsets */
    const real *v;       /* what is proposed */
    const real *low;
    const real *high;
    const real *w;
    const real *priority;
} qp;

/* Return a_i . u + b_i and its tolerance. */
static inline real residual(const qp *p, int i, const real *u, real *allowed)
{
    real total = 0, rounding = 0;
    for (int j = 0; j < p->m; j++) {
        const real term = p->a[i * p->m + j] * u[j];
        total += term;
        rounding += ROUNDING * ABS(term);
    }
    *allowed = rounding + ROUNDING * ABS(p->b[i]);
    return total + p->b[i];
}

/* Write margins and binding constraints; return how many are not met. */
static inline int count_unmet(const qp *p, const real *u, real *margin, bool *active)
{
    int unmet = 0;
    for (int i = 0; i < p->k; i++) {
        real allowed;
        margin[i] = residual(p, i, u, &allowed);
        active[i] = margin[i] <= allowed;
        unmet += !(margin[i] >= -allowed);
    }
    return unmet;
}

#if ONE_INPUT
/* Return the margin of a constraint on one input, and its tolerance.
 *
 * An uncertain one asks for a u + b >= sqrt(q_0 + 2 q_1 u + q_2 u^2), with its q in `forms`, which
 * is NULL where none is uncertain.
 */
static real interval_residual(const qp *p, const real *forms, int i, real u, real *allowed)
{
    const real term = p->a[i] * u, b = p->b[i];
    real value = term + b;
    *allowed = ROUNDING * ABS(b) + ROUNDING * ABS(term);
    if (forms) {
        const real *q = forms + 3 * i;
        const real form = positive_part(q[0] + u * (2 * q[1] + u * q[2]));
        const real doubt = ROUNDING * (ABS(q[0]) + ABS(2 * q[1] * u) + q[2] * u * u);
        const real root = SQRT(form);
        value -= root;
        *allowed += SQRT(form + doubt) - root;
    }
    return value;
}

/* Return the input nearest to v of those with the least sum of squared slacks.
 *
 * The sum is convex. Newton's method finds where its derivative vanishes, and bisection helps it.
 */
static real least_slack(const qp *p, const real *forms)
{
    real low = p->low[0], high = p->high[0], size = 0;
    for (int i = 0; i < p->k; i++) {
        real top = larger(ABS(p->a[i]), ABS(p->b[i]));
        if (forms) {
            top = larger(top, SQRT(ABS(forms[3 * i])));
            top = larger(top, SQRT(ABS(forms[3 * i + 2])));
        }
        size = larger(size, SQRT(p->priority[i]) * top);
    }
    real u = clip(p->v[0], low, high);
    for (int count = 0; count < BISECTIONS; count++) {
        real rate = 0, curvature = 0;
        for (int i = 0; i < p->k; i++) {
            /* So that squares neither overflow nor vanish. */
            const real unit = SQRT(p->priority[i]) / size;
            real slope = p->a[i] * unit, bend = 0;
            real value = slope * u + p->b[i] * unit;
            if (forms) {
                const real *q = forms + 3 * i;
                const real q1 = q[1] * unit * unit, q2 = q[2] * unit * unit;
                const real root = SQRT(positive_part(q[0] * unit * unit + u * (2 * q1 + u * q2)));
                value -= root;
                if (root > 0) {
                    const real change = (q1 + q2 * u) / root;
                    slope -= change;
                    bend = (q2 - change * change) / root;
                }
            }
            if (value < 0) {
                rate += value * slope;
                curvature += slope * slope - value * bend;
            }
        }
        if (rate > 0) {
            high = u;
        } else if (rate < 0) {
            low = u;
        } else if (curvature > 0 || count == 0) {
            return u;
        } else if (u < p->v[0]) {
            low = u;
        } else {
            high = u;
        }
        const real middle = low + (real)0.5 * (high - low), apart = 4 * ROUNDING * ABS(u);
        real best = curvature > 0 && count % 4 != 3 ? u - rate / curvature : middle;
        if (high - low <= 2 * apart) {
            return clip(best, low, high);
        }
        if (ABS(best - u) < apart) { /* there may be a kink next to it */
            best = rate > 0 ? u - apart : u + apart;
        }
        if (best <= low || best >= high) { /* the answer may be a bound of the input */
            const real end = best <= low ? low : high;
            best = end == p->low[0] || end == p->high[0] ? end : middle;
            if (best == u) {
                return u;
            }
        }
        u = best;
    }
    return u;
}

#if INTERVALS
/* Write where an uncertain constraint is met: a concave function of the input is positive.
 *
 * The ends are roots of (a^2 - q_2) u^2 + 2 (a b - q_1) u + b^2 - q_0 with a u + b >= 0. An empty
 * interval begins at the largest number.
 */
static void uncertain_interval(real a, real b, const real *q, real *first, real *last)
{
    real q0 = q[0], q1 = q[1], q2 = q[2];
    real unit = larger(larger(ABS(a), ABS(b)), larger(SQRT(ABS(q0)), SQRT(ABS(q2))));
    unit = unit > 0 ? unit : 1; /* so that products of four neither overflow nor vanish */
    a /= unit;
    b /= unit;
    q0 = q0 / unit / unit;
    q1 = q1 / unit / unit;
    q2 = q2 / unit / unit;
    *first = -LARGEST;
    *last = LARGEST;
    if (q2 == 0) {
        const real least = SQRT(positive_part(q0)) - b;
        if (a > 0) {
            *first = least / a;
        } else if (a < 0) {
            *last = least / a;
        } else if (least > 0) {
            *first = LARGEST;
        }
        return;
    }
    const real leading = a * a - q2, middle = a * b - q1, rest = b * b - q0;
    /* (a b - q_1)^2 - leading rest, without the products that cancel. */
    const real discriminant = a * a * q0 - 2 * a * b * q1 + b * b * q2 - (q0 * q2 - q1 * q1);
    const real root = SQRT(positive_part(discriminant));
    if (leading == 0) {
        if (middle * a <= 0) {
            *first = LARGEST;
        } else if (a > 0) {
            *first = -rest / (2 * middle);
        } else {
            *last = -rest / (2 * middle);
        }
        return;
    }
    const real t = -(middle + (middle >= 0 ? root : -root));
    const real one = t != 0 ? t / leading : 0, other = t != 0 ? rest / t : 0;
    const real start = smaller(one, other), end = larger(one, other);
    if (leading > 0) {
        if (a > 0) {
            *first = end;
        } else {
            *last = start;
        }
    } else if (discriminant < 0 || b - a * middle / leading < 0) {
        *first = LARGEST;
    } else {
        *first = start;
        *last = end;
    }
}
#endif

/* Project one input onto constraints that are each met on an interval. */
static bool project_interval(
    const qp *p, const real *forms, real *u, real *margin, bool *active)
{
    const real v = p->v[0], low = p->low[0], high = p->high[0];
    real first = low, last = high, starts[ROWS], ends[ROWS], allowed;
    bool satisfied = true, solvable = false;
    u[0] = clip(v, low, high);
    for (int i = 0; i < p->k; i++) {
        margin[i] = interval_residual(p, forms, i, u[0], &allowed);
        active[i] = false;
        satisfied = satisfied && margin[i] >= 0;
    }
    if (satisfied) {
        return true;
    }
    for (int i = 0; i < p->k; i++) {
        starts[i] = -LARGEST;
        ends[i] = LARGEST;
#if INTERVALS
        if (forms) {
            uncertain_interval(p->a[i], p->b[i], forms + 3 * i, &starts[i], &ends[i]);
        } else
#endif
        if (p->a[i] > 0) {
            starts[i] = -p->b[i] / p->a[i];
        } else if (p->a[i] < 0) {
            ends[i] = -p->b[i] / p->a[i];
        }
        first = larger(first, starts[i]);
        last = smaller(last, ends[i]);
    }
    /* Two constraints that meet in one point may miss each other by the rounding of their roots. */
    u[0] = clip(smaller(larger(v, first), last), low, high);
    /* Where one alone is missed, its interval is beyond a bound, which is the answer. */
    for (int i = 0; (p->k > 1 || forms) && i < p->k; i++) {
        const real value = interval_residual(p, forms, i, u[0], &allowed);
        const bool silent = !forms && p->a[i] == 0;
        solvable = solvable || (value < -allowed && !silent);
    }
    if (solvable) {
        u[0] = least_slack(p, forms);
    }
    bool feasible = true;
    for (int i = 0; i < p->k; i++) {
        margin[i] = interval_residual(p, forms, i, u[0], &allowed);
        /* An end may be rounded by more than the margin that is nothing but rounding. */
        const bool at_end = forms && (u[0] == starts[i] || u[0] == ends[i]);
        active[i] = margin[i] <= allowed || at_end;
        feasible = feasible && margin[i] >= -allowed;
    }
    return feasible;
}
#endif

#if COLUMNS > 1
/* How inputs move along the multiplier of a constraint. */
typedef struct {
    real row[COLUMNS];       /* coefficients, over the largest */
    real direction[COLUMNS]; /* of each input, 0 where it is not free */
    real start[COLUMNS];
    real far[COLUMNS];
    real enter[COLUMNS]; /* multipliers at which an input begins to move */
    real leave[COLUMNS]; /* and at which it ends */
} row_path;

/* Write the input at a multiplier, and return the value of the constraint there. */
static real follow_row(const row_path *path, int m, real b, real multiplier, real *u)
{
    real total = b;
    for (int j = 0; j < m; j++) {
        const real passed = multiplier - path->enter[j];
        u[j] = path->start[j];
        if (multiplier >= path->leave[j]) {
            u[j] = path->far[j];
        } else if (passed > 0) {
            u[j] += passed * path->direction[j];
        }
        total += path->row[j] * u[j];
    }
    return total;
}

/* Write the nearest input that meets constraint i, or violates it least.
 *
 * The minimiser is u(l) = clip(v + l a / w) for the smallest multiplier l >= 0 at which
 * phi(l) = a . u(l) + b is 0. phi is piecewise linear and does not fall, with a kink wherever an
 * input enters or leaves its interval. An input whose proposal is beyond its near bound is measured
 * from there once it enters, so that a proposal of 1e16 does not drown it.
 */
static void project_row(const qp *p, int i, real *u)
{
    const int m = p->m;
    const real *a = p->a + i * m, b = p->b[i];
    real along[COLUMNS], value = b, slope = 0, size, allowed;
    for (int j = 0; j < m; j++) {
        along[j] = a[j] / p->w[j];
        value += a[j] * p->v[j];
        slope += a[j] * along[j];
    }
    if (SMALL_SQUARE < slope && slope < LARGE_SQUARE) {
        const real step = value / slope;
        bool inside = true;
        for (int j = 0; j < m; j++) {
            const real low = p->low[j], high = p->high[j], reach = FAR_OFF * (high - low);
            u[j] = p->v[j] - step * along[j];
            inside = inside && low <= u[j] && u[j] <= high && low - reach <= p->v[j]
                && p->v[j] <= high + reach;
        }
        if (inside) {
            value = residual(p, i, u, &allowed);
            if (-allowed <= value && value <= allowed) {
                return;
            }
        }
    }
    row_path path = {{0}, {0}, {0}, {0}, {0}, {0}};
    size = size_of(m, a);
    size = size > 0 ? size : 1; /* so that products neither overflow nor vanish */
    for (int j = 0; j < m; j++) {
        const real low = p->low[j], high = p->high[j], v = p->v[j];
        path.row[j] = a[j] / size;
        const real d = path.row[j] / p->w[j];
        path.direction[j] = d;
        path.start[j] = clip(v, low, high);
        path.far[j] = d > 0 ? high : d < 0 ? low : path.start[j];
        path.enter[j] = path.leave[j] = 0;
        if (d != 0) {
            path.enter[j] = positive_part(((d > 0 ? low : high) - v) / d);
            path.leave[j] = positive_part((path.far[j] - v) / d);
        }
    }
    /* The last kink at which the constraint is violated; the first candidate is the start. */
    real kink = 0;
    for (int c = 0; c < 2 * m; c++) {
        const real at = c < m ? path.enter[c] : path.leave[c - m];
        if (at > kink && follow_row(&path, m, b / size, at, u) < 0) {
            kink = at;
        }
    }
    value = follow_row(&path, m, b / size, kink, u);
    slope = 0;
    for (int j = 0; j < m; j++) {
        const real enter = path.enter[j], leave = path.leave[j];
        /* An input so far off that it enters and leaves at one multiplier, by rounding, is free. */
        const bool moves = (enter <= kink && kink < leave) || (enter == kink && kink == leave);
        if (!moves || path.start[j] == path.far[j]) {
            path.direction[j] = 0;
        }
        slope += path.row[j] * path.direction[j];
    }
    if (!(slope > 0)) {
        for (int j = 0; j < m; j++) {
            u[j] = path.far[j];
        }
        return;
    }
    real step = value < 0 ? value / slope : 0;
    for (int c = 0; c < CORRECTIONS; c++) { /* divide among the free inputs what rounding leaves */
        for (int j = 0; j < m; j++) {
            if (path.direction[j] != 0) {
                u[j] = clip(u[j] - step * path.direction[j], p->low[j], p->high[j]);
            }
        }
        value = residual(p, i, u, &allowed);
        if (-allowed <= value && value <= allowed) {
            return;
        }
        step = value / size / slope;
    }
}
#endif

#if SEVERAL
/* Orthonormal vectors, and how given ones are sums of them. */
typedef struct {
    real vectors[MOST_VECTORS * MOST_ENTRIES];
    real triangle[MOST_VECTORS * MOST_VECTORS]; /* row by row: share of each in those given */
    int order[MOST_VECTORS];                    /* numbers of the given ones */
    int size;
    int n; /* entries of a vector */
} basis;

/* Orthonormalise the free entries of those of `count` vectors of n entries that are taken.
 *
 * Each is the sum of the triangle times the basis, up to its own place. One that depends on those
 * before it, up to rounding, is left out. What is not free in `fixed` is not 0; all is where it is
 * NULL, as all are taken where `taken` is.
 */
static void span(
    basis *base, int count, int n, const real *vectors, const bool *taken, const signed char *fixed)
{
    base->size = 0;
    base->n = n;
    for (int i = 0; i < count && base->size < n; i++) {
        if (taken && !taken[i]) {
            continue;
        }
        real *fresh = base->vectors + base->size * n, *shares = base->triangle + base->size;
        for (int j = 0; j < n; j++) {
            fresh[j] = fixed && fixed[j] ? 0 : vectors[i * n + j];
        }
        const real whole = dot(n, fresh, fresh);
        for (int c = 0; c < base->size; c++) {
            shares[c * MOST_VECTORS] = 0;
        }
        /* The second time takes back rounding. */
        for (int times = 0; times < (base->size > 0 ? 2 : 0); times++) {
            for (int c = 0; c < base->size; c++) {
                const real share = dot(n, base->vectors + c * n, fresh);
                shares[c * MOST_VECTORS] += share;
                add_multiple(n, -share, base->vectors + c * n, fresh);
            }
        }
        const real left = dot(n, fresh, fresh);
        if (left > DEPENDENT * DEPENDENT * whole) {
            const real length = SQRT(left);
            for (int j = 0; j < n; j++) {
                fresh[j] /= length;
            }
            shares[base->size * MOST_VECTORS] = length;
            base->order[base->size++] = i;
        }
    }
}

/* Write the free entries of a vector as a sum of vectors of a basis and a rest normal to them. */
static void split(
    const basis *base, const real *vector, const signed char *fixed, real *shares, real *rest)
{
    const int n = base->n;
    for (int j = 0; j < n; j++) {
        rest[j] = fixed && fixed[j] ? 0 : vector[j];
    }
    for (int c = 0; c < base->size; c++) {
        shares[c] = 0;
    }
    for (int times = 0; times < 2; times++) {
        for (int c = 0; c < base->size; c++) {
            const real share = dot(n, base->vectors + c * n, rest);
            shares[c] += share;
            add_multiple(n, -share, base->vectors + c * n, rest);
        }
    }
    for (int c = base->size - 1; c >= 0; c--) {
        for (int d = c + 1; d < base->size; d++) {
            shares[c] -= base->triangle[c * MOST_VECTORS + d] * shares[d];
        }
        shares[c] /= base->triangle[c * MOST_VECTORS + c];
    }
}

/* Write the shortest step whose products with the vectors of a basis are given; these change. */
static void least_step(const basis *base, real *products, real *step)
{
    const int n = base->n;
    for (int j = 0; j < n; j++) {
        step[j] = 0;
    }
    for (int c = 0; c < base->size; c++) {
        for (int d = 0; d < c; d++) {
            products[c] -= base->triangle[d * MOST_VECTORS + c] * products[d];
        }
        products[c] /= base->triangle[c * MOST_VECTORS + c];
        add_multiple(n, products[c], base->vectors + c * n, step);
    }
}

/* Weighted constraints whose slacks are reduced, in a unit in which no square overflows. */
typedef struct {
    real a[ROWS * COLUMNS];
    real b[ROWS];
    real margin[ROWS];
    bool violated[ROWS];        /* which take part in a step */
    signed char fixed[COLUMNS]; /* which inputs do not, not 0 */
    bool barred[ROWS + COLUMNS]; /* constraints, and inputs, once let go and stopped at once */
} slacks;

/* Write the weighted margins; return the sum of squared slacks. */
static real slack_margins(const qp *p, slacks *s, const real *u)
{
    real squares = 0;
    for (int i = 0; i < p->k; i++) {
        s->margin[i] = dot(p->m, s->a + i * p->m, u) + s->b[i];
        if (s->margin[i] < 0) {
            squares += s->margin[i] * s->margin[i];
        }
    }
    return squares;
}

/* Write the shortest step of the free inputs with the least squares of the violated margins. */
static void fit_step(const qp *p, const slacks *s, real *step)
{
    const int k = p->k, m = p->m;
    basis rows, columns;
    real shares[MOST_VECTORS], target[ROWS], rest[ROWS], slopes[MOST_VECTORS * ROWS];
    int taken = 0;
    span(&rows, k, m, s->a, s->violated, s->fixed);
    for (int i = 0; i < k; i++) {
        taken += s->violated[i];
    }
    if (taken == rows.size) { /* all margins can be 0 */
        for (int c = 0; c < rows.size; c++) {
            shares[c] = -s->margin[rows.order[c]];
        }
        least_step(&rows, shares, step);
        return;
    }
    /* In an orthonormal basis of the constraints the problem has full rank. */
    for (int i = 0; i < k; i++) {
        target[i] = s->violated[i] ? -s->margin[i] : 0;
        for (int c = 0; c < rows.size; c++) {
            slopes[c * k + i] = s->violated[i] ? dot(m, s->a + i * m, rows.vectors + c * m) : 0;
        }
    }
    span(&columns, rows.size, k, slopes, NULL, NULL);
    split(&columns, target, NULL, shares, rest);
    for (int j = 0; j < m; j++) {
        step[j] = 0;
    }
    for (int c = 0; c < columns.size; c++) {
        add_multiple(m, shares[c], rows.vectors + columns.order[c] * m, step);
    }
}

/* Let go of the constraint that is met by most, or else of the input that is pushed inwards.
 *
 * Return the constraint, or k plus the input, or -1.
 */
static int release(const qp *p, slacks *s, const real *u)
{
    const int k = p->k, m = p->m;
    real largest = 0, strongest = 0;
    int freed = -1;
    for (int i = 0; i < k; i++) {
        if (s->violated[i]) {
            const real pull = size_of(m, s->a + i * m) * s->margin[i];
            largest = larger(largest, ABS(pull));
            if (!s->barred[i] && pull > strongest) {
                freed = i;
                strongest = pull;
            }
        }
    }
    if (strongest > NO_FORCE * largest) {
        s->violated[freed] = false;
        return freed;
    }
    freed = -1;
    strongest = 0;
    for (int j = 0; j < m; j++) {
        if (s->fixed[j] && !s->barred[k + j]) {
            real push = 0, terms = 0;
            for (int i = 0; i < k; i++) {
                if (s->violated[i]) {
                    const real force = s->margin[i] * s->a[i * m + j];
                    push -= force;
                    terms += ABS(force);
                }
            }
            push = u[j] >= p->high[j] ? -push : push;
            if (push > NO_FORCE * terms && push > strongest) {
                freed = j;
                strongest = push;
            }
        }
    }
    if (freed < 0) {
        return -1;
    }
    s->fixed[freed] = 0;
    return k + freed;
}

/* Return whether no input within its bounds changes a constraint by more than rounding may. */
static bool is_silent(const qp *p, int i)
{
    const real rounding = sizeof(real) == sizeof(float) ? ROUNDING : SURELY * ROUNDING;
    real reach = 0;
    for (int j = 0; j < p->m; j++) {
        const real a = ABS(p->a[i * p->m + j]);
        reach += a > 0 ? a * (p->high[j] - p->low[j]) : 0;
    }
    return reach <= rounding * ABS(p->b[i]);
}

/* Move the input to where the sum of weighted squared slacks is least, inside its bounds.
 *
 * In a `corner`, its bounds hold the input from the start. `hard` receives which bounds hold it
 * wherever the sum is least, -1 for a lower and 1 for an upper one.
 *
 * Each step is the least-squares step of the violated constraints over the free inputs (Stark,
 * Parker, Bounded-variable least squares, Computational Statistics 10, 1995). It ends where an
 * input meets its bound, which holds it from then on, or where another constraint is on the point
 * of being violated, which takes part from then on.
 */
static void reduce_slacks(const qp *p, bool corner, real *u, signed char *hard)
{
    const int k = p->k, m = p->m;
    slacks s;
    real step[COLUMNS], reach[ROWS], size = 0;
    for (int i = 0; i < k; i++) {
        size = larger(size, SQRT(p->priority[i]) * size_of(m, p->a + i * m));
    }
    for (int i = 0; i < k; i++) {
        const real unit = is_silent(p, i) ? 0 : SQRT(p->priority[i]) / size;
        for (int j = 0; j < m; j++) {
            s.a[i * m + j] = unit * p->a[i * m + j];
        }
        s.b[i] = unit * p->b[i];
    }
    (void)slack_margins(p, &s, u);
    for (int i = 0; i < k; i++) {
        s.violated[i] = s.margin[i] < 0;
    }
    for (int j = 0; j < m; j++) {
        s.fixed[j] = corner && (u[j] == p->low[j] || u[j] == p->high[j]);
    }
    for (int c = 0; c < k + m; c++) {
        s.barred[c] = false;
    }
    int freed = -1;
    bool done = false;
    for (int count = 0; count < STEPS * (k + m); count++) {
        fit_step(p, &s, step);
        if (done) {
            break;
        }
        real length = 1;
        for (int j = 0; j < m; j++) {
            if (step[j] != 0) {
                const real end = step[j] > 0 ? p->high[j] : p->low[j];
                length = smaller(length, (end - u[j]) / step[j]);
            }
        }
        for (int i = 0; i < k; i++) {
            reach[i] = 2;
            if (!s.violated[i]) {
                const real change = dot(m, s.a + i * m, step);
                if (change < 0) {
                    reach[i] = positive_part(s.margin[i]) / -change;
                    length = smaller(length, reach[i]);
                }
            }
        }
        for (int j = 0; j < m; j++) {
            if (step[j] != 0) {
                const real end = step[j] > 0 ? p->high[j] : p->low[j];
                real x = u[j] + length * step[j];
                if ((end - u[j]) / step[j] <= length) {
                    x = end;
                    s.fixed[j] = length < 1 ? 1 : s.fixed[j];
                }
                u[j] = clip(x, p->low[j], p->high[j]);
            }
        }
        if (slack_margins(p, &s, u) == 0) {
            break; /* all constraints can be met */
        }
        if (length < 1) {
            for (int i = 0; i < k; i++) {
                s.violated[i] = s.violated[i] || reach[i] <= length;
            }
            if (freed >= 0 && !(length > 0)) { /* let go and stopped at once: once is enough */
                s.barred[freed] = freed < k ? s.violated[freed] : s.fixed[freed - k] != 0;
            }
            for (int c = 0; length > 0 && c < k + m; c++) {
                s.barred[c] = false;
            }
            freed = -1;
        } else {
            freed = release(p, &s, u);
            done = freed < 0;
        }
    }
    /* The margins are those of many steps; a last one takes back their rounding or leads astray. */
    real least = slack_margins(p, &s, u), allowed;
    if (least > 0) {
        real last[COLUMNS];
        const real before = least;
        for (int j = 0; j < m; j++) {
            last[j] = u[j];
            u[j] = clip(u[j] + step[j], p->low[j], p->high[j]);
        }
        least = slack_margins(p, &s, u);
        if (!(least < before)) {
            for (int j = 0; j < m; j++) {
                u[j] = last[j];
            }
            least = slack_margins(p, &s, u);
        }
    }
    /* The slacks are the same wherever their sum is least; so are their forces on the bounds. */
    bool certain = least > 0;
    for (int i = 0; i < k; i++) {
        certain = certain && ABS(residual(p, i, u, &allowed)) > SURELY * allowed;
    }
    for (int j = 0; j < m; j++) {
        real push = 0, terms = 0;
        for (int i = 0; certain && i < k; i++) {
            if (s.margin[i] < 0) {
                const real force = -s.margin[i] * s.a[i * m + j];
                push += force;
                terms += ABS(force);
            }
        }
        hard[j] = 0;
        if (ABS(push) > 2 / SURELY * terms && u[j] == (push > 0 ? p->high[j] : p->low[j])) {
            hard[j] = push > 0 ? 1 : -1;
        }
    }
}

/* Go from the least-violating input to the nearest to the proposal with no larger slack.
 *
 * Where no step leads nearer, the rest of the distance is a sum of the normals of what holds the
 * input back. What has the wrong sign in it is let go (Nocedal, Wright, Numerical Optimization,
 * Sec. 16.5). Distances are those of sqrt(w) u, in which constraints have unit length. `fixed` has
 * 2 for bounds that hold the input for good, 1 for those that hold it now, negative for lower ones.
 */
static void approach(const qp *p, const signed char *hard, real *u)
{
    const int k = p->k, m = p->m;
    real normal[ROWS * COLUMNS], length[ROWS], spare[ROWS], offset[ROWS], least[ROWS];
    real root[COLUMNS], start[COLUMNS], step[COLUMNS], distance[COLUMNS], rest[COLUMNS];
    real move[COLUMNS], shares[COLUMNS], whole, allowed;
    bool binding[ROWS], reached[COLUMNS], violated = false;
    signed char fixed[COLUMNS];
    basis base;
    for (int j = 0; j < m; j++) {
        root[j] = SQRT(p->w[j]);
        start[j] = u[j];
        fixed[j] = (signed char)(2 * hard[j]);
        step[j] = 0;
        reached[j] = false; /* whether a constraint depends on the input */
    }
    for (int i = 0; i < k; i++) {
        real *row = normal + i * m;
        const bool silent = is_silent(p, i);
        for (int j = 0; j < m; j++) {
            row[j] = silent ? 0 : p->a[i * m + j] / root[j];
            reached[j] = reached[j] || row[j] != 0;
        }
        const real size = size_of(m, row);
        for (int j = 0; size > 0 && j < m; j++) {
            row[j] /= size; /* squares neither overflow nor vanish */
        }
        const real norm = SQRT(dot(m, row, row));
        for (int j = 0; size > 0 && j < m; j++) {
            row[j] /= norm;
        }
        length[i] = size * norm;
        const real value = residual(p, i, u, &allowed);
        const real slack = value < -allowed ? -value : 0;
        offset[i] = p->b[i] + slack;
        least[i] = -slack;
        violated = violated || slack > 0;
        spare[i] = size > 0 ? positive_part(value) / length[i] : 0;
        binding[i] = size > 0 && value <= allowed;
    }
    for (int j = 0; j < m; j++) {
        distance[j] = reached[j] ? (p->v[j] - u[j]) * root[j] : 0;
    }
    whole = size_of(m, distance);
    for (int count = 0; count < STEPS * (k + m); count++) {
        real left = 0, size = 0, part = 1;
        int stop = -1;
        span(&base, k, m, normal, binding, fixed);
        for (int j = 0; j < m; j++) {
            rest[j] = distance[j] - step[j];
        }
        split(&base, rest, fixed, shares, move);
        for (int j = 0; j < m; j++) {
            if (!fixed[j]) {
                left = larger(left, ABS(rest[j]));
                size = larger(size, ABS(move[j]));
            }
        }
        if (size > NO_DISTANCE * left) {
            for (int j = 0; j < m; j++) {
                if (move[j] != 0) {
                    const real end = move[j] > 0 ? p->high[j] : p->low[j];
                    const real to_end = ((end - start[j]) * root[j] - step[j]) / move[j];
                    if (to_end < part) {
                        part = to_end;
                        stop = k + j;
                    }
                }
            }
            for (int i = 0; i < k; i++) {
                if (!binding[i]) {
                    const real change = dot(m, normal + i * m, move);
                    const real value = spare[i] + dot(m, normal + i * m, step);
                    const real to_row = positive_part(value) / -change;
                    if (change < -NO_DISTANCE * size && to_row < part) {
                        part = to_row;
                        stop = i;
                    }
                }
            }
            for (int j = 0; j < m; j++) {
                const real low = (p->low[j] - start[j]) * root[j];
                const real high = (p->high[j] - start[j]) * root[j];
                real x = step[j] + part * move[j];
                if (stop == k + j) {
                    fixed[j] = move[j] > 0 ? 1 : -1;
                    x = move[j] > 0 ? high : low;
                }
                step[j] = clip(x, low, high);
            }
            if (stop >= 0 && stop < k) {
                binding[stop] = true;
            }
            if (stop >= 0) {
                continue;
            }
        }
        real strongest = NO_DISTANCE * whole;
        int freed = -1;
        for (int c = 0; c < base.size; c++) {
            if (shares[c] > strongest) {
                freed = base.order[c];
                strongest = shares[c];
            }
        }
        for (int j = 0; j < m; j++) {
            if (fixed[j] == 1 || fixed[j] == -1) {
                real push = rest[j];
                for (int c = 0; c < base.size; c++) {
                    push -= shares[c] * normal[base.order[c] * m + j];
                }
                push *= (real)-fixed[j];
                if (push > strongest) {
                    freed = k + j;
                    strongest = push;
                }
            }
        }
        if (freed < 0) {
            break;
        }
        if (freed < k) {
            binding[freed] = false;
        } else {
            fixed[freed - k] = 0;
        }
    }
    bool moved = false;
    for (int j = 0; j < m; j++) {
        moved = moved || step[j] != 0;
        u[j] = fixed[j] < 0 ? p->low[j] : fixed[j] > 0 ? p->high[j] : start[j] + step[j] / root[j];
    }
    /* Where the input does not move, nearly parallel constraints would only add rounding. */
    while (moved) {
        span(&base, k, m, normal, binding, fixed);
        for (int times = 0; times < 2; times++) { /* the second time takes back rounding */
            for (int c = 0; c < base.size; c++) {
                const int i = base.order[c];
                shares[c] = (dot(m, p->a + i * m, u) + offset[i]) / length[i];
            }
            least_step(&base, shares, rest);
            for (int j = 0; j < m; j++) {
                u[j] -= rest[j] / root[j];
            }
        }
        moved = false;
        for (int j = 0; j < m; j++) {
            const real x = clip(u[j], p->low[j], p->high[j]);
            if (x != u[j] && !fixed[j]) { /* then this bound holds it, too */
                fixed[j] = 1;
                moved = true;
            }
            u[j] = x;
        }
    }
    whole = 0;
    for (int j = 0; j < m; j++) {
        whole = larger(whole, ABS(u[j] - p->v[j]) * root[j]);
    }
    for (int j = 0; j < m; j++) {
        /* A constraint of an input alone may ask for 0, which rounding of the distance hides. */
        if (ABS(u[j]) <= ROUNDING * whole / root[j]) {
            u[j] = clip(0, p->low[j], p->high[j]);
        }
    }
    /* Where constraints or inputs differ by many orders of magnitude, rounding may lead astray:
     * then the least-violating input is safer. */
    bool worse = false;
    for (int i = 0; i < k; i++) {
        const real value = residual(p, i, u, &allowed);
        worse = worse || !(value + (violated ? SURELY : 1) * allowed >= least[i]);
    }
    for (int j = 0; worse && j < m; j++) {
        u[j] = start[j];
    }
}

/* Project several inputs onto several constraints, of which the clipped proposal misses some.
 *
 * If the answer for one constraint alone meets the others, it is the answer. Otherwise the slacks
 * are reduced first, and then the distance to the proposal.
 */
static bool project_rows(const qp *p, real *u, real *margin, bool *active)
{
    const int k = p->k, m = p->m;
    bool missed[ROWS], corner = false;
    signed char hard[COLUMNS];
    int hopeless = 0;
    real allowed;
    for (int i = 0; i < k; i++) {
        missed[i] = !(margin[i] >= 0);
        if (missed[i]) {
            /* One that says nothing of the input cannot be met, and has no part in what follows. */
            missed[i] = !is_silent(p, i);
            hopeless += !missed[i];
        }
    }
    for (int i = 0; i < k && !corner; i++) {
        if (missed[i]) {
            project_row(p, i, u);
            if (count_unmet(p, u, margin, active) == hopeless) {
                active[i] = true; /* whatever the rounding of its margin */
                return hopeless == 0;
            }
            const real value = residual(p, i, u, &allowed);
            corner = value < -allowed; /* even alone it cannot be met */
        }
    }
    for (int j = 0; j < m && !corner; j++) {
        u[j] = clip(p->v[j], p->low[j], p->high[j]);
    }
    if (hopeless < k) {
        reduce_slacks(p, corner, u, hard);
        approach(p, hard, u);
    }
    return count_unmet(p, u, margin, active) == 0;
}
#endif

/* Write the answer; return whether all constraints can be met.
 *
 * Of the constraints those are active that bind or cannot be met; none is where the clipped
 * proposal meets them all.
 */
HELPER bool project(const qp *p, real *u, real *margin, bool *active)
{
#if ONE_INPUT && COLUMNS > 1
    if (p->m == 1) {
        return project_interval(p, NULL, u, margin, active);
    }
#endif
#if COLUMNS == 1
    return project_interval(p, NULL, u, margin, active);
#else
    bool satisfied = true;
    real allowed;
    for (int j = 0; j < p->m; j++) {
        u[j] = clip(p->v[j], p->low[j], p->high[j]);
    }
    for (int i = 0; i < p->k; i++) {
        margin[i] = residual(p, i, u, &allowed);
        active[i] = false;
        satisfied = satisfied && margin[i] >= 0;
    }
    if (satisfied) {
        return true;
    }
#if SEVERAL
    if (p->k > 1) {
        return project_rows(p, u, margin, active);
    }
#endif
    project_row(p, 0, u);
    margin[0] = residual(p, 0, u, &allowed);
    active[0] = true;
    return margin[0] >= -allowed;
#endif
}

/* Return the size of the largest coefficient; 1 where all are 0. */
static inline real unit_of_row(const real *a)
{
    const real size = size_of(INPUTS, a);
    return size > 0 ? size : 1;
}

/* Return how far an input is from the half-space of a constraint; `silent` where all a are 0. */
static real distance_to_row(const real *a, real b, const real *u, real silent)
{
    const real unit = unit_of_row(a);
    real square = 0;
    for (int j = 0; j < INPUTS; j++) {
        const real share = a[j] / unit; /* squares neither overflow nor vanish */
        square += share * share / input_weight[j];
    }
    return square > 0 ? -(dot(INPUTS, a, u) + b) / unit / SQRT(square) : silent;
}

/* What a decision is made of; the first three are arguments. */
typedef struct {
    const real *x;       /* state, what is measured at run time, and learned terms */
    const real *low;     /* bounds of the inputs */
    const real *high;
    real wanted[INPUTS]; /* what constraints change: the proposal, or the best of the goal */
    real values[VALUES]; /* of the formulas */
    real asked[CONSTRAINTS]; /* offsets, less what reciprocal constraints demand */
    bool known[CONSTRAINTS]; /* whether the barrier has a value */
    bool inside[CONSTRAINTS]; /* whether the constraint is in its domain */
    real u[COLUMNS]; /* the action, and the slack of the goal */
    real margin[CONSTRAINTS + GOAL];
    bool active[CONSTRAINTS + GOAL];
    bool feasible;
} decision;

#if GOAL
/* Write the goal's constraint growth + along . u <= d with d = unit e, and the bounds of e.
 *
 * Its bounds are 0 and twice the most that it may have to be, so that the constraint can always be
 * met, also after rounding.
 */
static void goal_row(const decision *d, real *a, real *b, real *low, real *high)
{
    const real *growth = d->values + GROWTH;
    real most = 0;
    for (int j = 0; j < INPUTS; j++) {
        most += larger(growth[1 + j] * d->low[j], growth[1 + j] * d->high[j]);
        low[j] = d->low[j];
        high[j] = d->high[j];
        a[j] = -growth[1 + j];
    }
    most += growth[0];
    low[INPUTS] = 0;
    high[INPUTS] = most > 0 ? 2 * most / goal_unit : 1;
    a[INPUTS] = goal_unit;
    *b = -growth[0];
}

/* Write what is wanted: the input that is best for the goal without constraints. */
static void pursue(decision *d)
{
    real a[COLUMNS], b, low[COLUMNS], high[COLUMNS], best[COLUMNS], margin;
    const real nothing[COLUMNS] = {0};
    bool active;
    goal_row(d, a, &b, low, high);
    const qp p = {1, COLUMNS, a, &b, nothing, low, high, input_weight, slack_weight};
    (void)project(&p, best, &margin, &active);
    for (int j = 0; j < INPUTS; j++) {
        d->wanted[j] = best[j];
    }
}
#endif

#if MAXIMA
/* Take the constraint of each maximum: that of a function whose set is nearest to what is wanted.
 *
 * It is one whose set holds the state: the constraint of another would not keep the maximum. Where
 * none of these can be met, and outside of all sets, it is the largest one's. Return whether all
 * levels are finite.
 */
static bool choose_functions(decision *d)
{
    const int width = INPUTS + 2; /* coefficients, offset and level of a function */
    real functions[FUNCTIONS * (INPUTS + 2)], *f = functions;
    bool finite = true;
    function_values(d->x, functions);
    for (int i = 0; i < CONSTRAINTS; i++) {
        const int count = kinds[i].functions;
        if (!count) {
            continue;
        }
        d->known[i] = d->known[i] && (!kinds[i].partial || isfinite(sum_of(count * width, f)));
        for (int e = 0; e < count * width; e++) {
            f[e] = d->known[i] ? f[e] : 0;
        }
        real top = f[INPUTS + 1], least = (real)INFINITY, levels = 0;
        int chosen = 0;
        for (int c = 0; c < count; c++) {
            levels += f[c * width + INPUTS + 1];
            if (f[c * width + INPUTS + 1] > top) {
                chosen = c;
                top = f[c * width + INPUTS + 1];
            }
        }
        for (int c = 0; c < count; c++) {
            const real *a = f + c * width, b = a[INPUTS], level = a[INPUTS + 1];
            real most = 0;
            for (int j = 0; j < INPUTS; j++) {
                most += larger(a[j] * d->low[j], a[j] * d->high[j]);
            }
            const real away = distance_to_row(a, b, d->wanted, -b);
            const real distance = positive_part(away);
            if ((level >= 0 || level == top) && b + most >= 0 && distance < least) {
                chosen = c;
                least = distance;
            }
        }
        for (int j = 0; j < INPUTS; j++) {
            d->values[i * INPUTS + j] = f[chosen * width + j];
        }
        d->values[OFFSETS + i] = f[chosen * width + INPUTS];
        finite = finite && isfinite(levels);
        f += count * width;
    }
    return finite;
}
#endif

#if RECIPROCAL
/* Aim far away where h of constraints outside their domain rises most, if any is.
 *
 * The allowed input nearest to one so far off is where h rises most among the allowed ones. Other
 * constraints are not to suffer from one that has no meaning.
 */
static void aim_outwards(const decision *d, real *aim)
{
    real rise[INPUTS] = {0}, steepness = 0, reach = 0;
    bool outside = false;
    for (int i = 0; i < CONSTRAINTS; i++) {
        if (!d->inside[i]) {
            const real size = unit_of_row(d->values + i * INPUTS);
            for (int j = 0; j < INPUTS; j++) {
                rise[j] += d->values[i * INPUTS + j] / size;
            }
            outside = true;
        }
    }
    if (!outside) {
        return;
    }
    const real size = unit_of_row(rise);
    for (int j = 0; j < INPUTS; j++) {
        rise[j] /= size;
        steepness += rise[j] * rise[j] / input_weight[j];
        reach += ABS(rise[j]) * (d->high[j] - d->low[j]);
    }
    const real far = FAR_AWAY * reach / (steepness > 0 ? steepness : 1);
    for (int j = 0; j < INPUTS; j++) {
        const real corner = rise[j] > 0 ? d->high[j] : rise[j] < 0 ? d->low[j] : aim[j];
        aim[j] = corner + far * rise[j] / input_weight[j];
    }
}
#endif

#if UNCERTAIN && !INTERVALS
/* Return entry i of [1, u] at corner c of the bounds. */
static real corner_entry(const decision *d, int c, int i)
{
    return i == 0 ? 1 : c >> (i - 1) & 1 ? d->high[i - 1] : d->low[i - 1];
}

/* Take a plane c_0 + c . u above sqrt([1, u]' Q [1, u]) within the bounds from a constraint.
 *
 * The slopes are the mean differences between the faces of the bounds, and c_0 is as small as the
 * corners allow: the root is convex, so that the plane is above it everywhere if it is there.
 */
static void take_plane(const decision *d, const real *q, real *a, real *b)
{
    const int corners = 1 << INPUTS;
    real roots[1 << INPUTS], slopes[INPUTS], above = 0;
    for (int c = 0; c < corners; c++) {
        const real *entry = q;
        real square = 0;
        for (int i = 0; i <= INPUTS; i++) {
            for (int j = i; j <= INPUTS; j++) {
                const real product = corner_entry(d, c, i) * corner_entry(d, c, j);
                square += *entry++ * (i == j ? product : 2 * product);
            }
        }
        roots[c] = SQRT(positive_part(square));
    }
    for (int j = 0; j < INPUTS; j++) {
        real rise = 0;
        for (int c = 0; c < corners; c++) {
            rise += c >> j & 1 ? roots[c] : -roots[c];
        }
        /* An input whose bounds are equal has no slope, whatever the rounding of its two faces. */
        const real width = d->high[j] - d->low[j];
        slopes[j] = width > 0 ? rise / ((real)0.5 * (real)corners * width) : 0;
        a[j] -= slopes[j];
    }
    for (int c = 0; c < corners; c++) {
        real gap = roots[c];
        for (int j = 0; j < INPUTS; j++) {
            gap -= slopes[j] * corner_entry(d, c, j + 1);
        }
        above = c == 0 ? gap : larger(above, gap);
    }
    *b -= above;
}
#endif

#if SAMPLED
/* A constraint on an input that is held for a period: the coefficients of 1, of the inputs u_j and
 * of u_j u_n, j <= n, and on one input those of an uncertainty. */
typedef struct {
    int owner; /* its constraint */
    real line[LINE];
    real form[3];
} held_row;

/* Its values on a line: of 1, t and t^2, the size of its terms, and those of its uncertainty. */
typedef struct {
    real value, rate, bend, size;
    real form[3];
} row_on_line;

/* Return whether all constraints hold at an input, and linearise them there.
 *
 * `missed` gets the constraints that do not hold, and keeps the others.
 */
static bool constraints_hold(
    const held_row *rows, const real *u, real *slopes, real *offsets, real *value, bool *missed)
{
    bool holds = true;
    for (int i = 0; i < HELD; i++) {
        const real *line = rows[i].line, *q = rows[i].form, *bend = line + 1 + INPUTS;
        real size = ABS(line[0]);
        value[i] = offsets[i] = line[0];
        for (int j = 0; j < INPUTS; j++) {
            const real term = line[1 + j] * u[j];
            value[i] += term;
            size += ABS(term);
            slopes[i * INPUTS + j] = line[1 + j];
        }
        for (int j = 0; j < INPUTS; j++) {
            for (int n = j; n < INPUTS; n++, bend++) {
                const real term = *bend * u[j] * u[n];
                value[i] += term;
                size += ABS(term);
                offsets[i] -= term;
                slopes[i * INPUTS + j] += *bend * u[n];
                slopes[i * INPUTS + n] += *bend * u[j];
            }
        }
        real allowed = ROUNDING * size;
        const real linear = 2 * q[1] * u[0], square = q[2] * u[0] * u[0];
        const real form = positive_part(q[0] + linear + square);
        if (form > 0) {
            const real root = SQRT(form), steepness = (q[1] + q[2] * u[0]) / root;
            allowed += SQRT(form + ROUNDING * (ABS(q[0]) + ABS(linear) + square)) - root;
            value[i] -= root;
            slopes[i * INPUTS] -= steepness;
            offsets[i] += steepness * u[0] - root;
        }
        if (!(value[i] >= -allowed)) {
            missed[i] = true;
            holds = false;
        }
    }
    return holds;
}

/* Return a quotient, 0 where it is none. */
static real ratio(real numerator, real denominator)
{
    return denominator != 0 ? numerator / denominator : 0;
}

/* Return the sum of the squared violations at a point of a line. */
static real violation_on_line(const held_row *rows, const row_on_line *lines, real t)
{
    real total = 0;
    for (int i = 0; i < HELD; i++) {
        const row_on_line *l = lines + i;
        const real linear = l->rate * t, square = l->bend * t * t;
        const real form = l->form[0] + l->form[1] * t + l->form[2] * t * t;
        const real value = l->value + linear + square - SQRT(positive_part(form));
        if (!(value >= -ROUNDING * (l->size + ABS(linear) + ABS(square)))) {
            total += slack_weight[rows[i].owner] * value * value;
        }
    }
    return total;
}

/* Return a point of a line at which a constraint may begin to hold, or is violated least.
 *
 * That is 0 for its vertex, 1 and 2 for its roots, 3 and 4 for those of an uncertain one; a little
 * beyond a root. Where there is none the point is 0.
 */
static real point_of_change(int which, const row_on_line *l)
{
    real constant = l->value, rate = l->rate, bend = l->bend;
    if (which == 0) {
        return ratio((real)-0.5 * rate, bend);
    }
    if (which > 2) {
        if (l->form[0] == 0 && l->form[2] == 0) {
            return 0; /* the constraint is certain */
        }
        bend = rate * rate - l->form[2];
        rate = 2 * constant * rate - l->form[1];
        constant = constant * constant - l->form[0];
    }
    const real root = SQRT(positive_part(rate * rate - 4 * bend * constant));
    const real half = (real)-0.5 * (rate + (rate > 0 ? root : -root));
    const real point = which % 2 ? ratio(half, bend) : ratio(constant, half);
    return point + ROUNDING * point;
}

/* Move an input along the line to another one, to where constraints are violated least.
 *
 * The other one, v, receives the direction. Return which share of the squared violations is left.
 */
static real move_on_line(const held_row *rows, const decision *d, real *u, real *v)
{
    real proposed = 1, first = -FAR_ON_LINE, last = FAR_ON_LINE;
    row_on_line lines[HELD];
    for (int j = 0; j < INPUTS; j++) {
        v[j] -= u[j];
    }
#if INPUTS == 1
    proposed = v[0]; /* there is one line, whatever is proposed */
    v[0] = 1;
#endif
    for (int j = 0; j < INPUTS; j++) {
        if (v[j] != 0) {
            const real start = ((v[j] > 0 ? d->low[j] : d->high[j]) - u[j]) / v[j];
            const real end = ((v[j] > 0 ? d->high[j] : d->low[j]) - u[j]) / v[j];
            first = larger(first, start);
            last = smaller(last, end);
        }
    }
    for (int i = 0; i < HELD; i++) {
        const real *line = rows[i].line, *q = rows[i].form, *c = line + 1 + INPUTS;
        row_on_line *l = lines + i;
        *l = (row_on_line){line[0], 0, 0, ABS(line[0]), {0}};
        for (int j = 0; j < INPUTS; j++) {
            l->value += line[1 + j] * u[j];
            l->rate += line[1 + j] * v[j];
            l->size += ABS(line[1 + j] * u[j]);
            for (int n = j; n < INPUTS; n++, c++) {
                l->value += *c * u[j] * u[n];
                l->rate += *c * (u[j] * v[n] + v[j] * u[n]);
                l->bend += *c * v[j] * v[n];
                l->size += ABS(*c * u[j] * u[n]);
            }
        }
        l->form[0] = q[0] + 2 * q[1] * u[0] + q[2] * u[0] * u[0];
        l->form[1] = 2 * (q[1] + q[2] * u[0]) * v[0];
        l->form[2] = q[2] * v[0] * v[0];
    }
    const real before = violation_on_line(rows, lines, 0);
    real best = 0, least = before;
    for (int c = 0; c <= POINTS * HELD; c++) {
        const bool changes = c < POINTS * HELD;
        const real point = changes ? point_of_change(c % POINTS, lines + c / POINTS) : proposed;
        const real t = clip(point, first, last);
        const real missed = violation_on_line(rows, lines, t);
        if (missed < BETTER * least || (missed == least && ABS(t) < ABS(best))) {
            best = t;
            least = missed;
        }
    }
    for (int j = 0; j < INPUTS; j++) {
        u[j] = clip(u[j] + best * v[j], d->low[j], d->high[j]);
    }
    return before > 0 ? least / before : 1;
}

/* Move the action to where the constraints hold all along the period; return whether all is finite.
 *
 * To first order a constraint is q(u) = a u + b + dt (c_0 + c u + u' C u) at the end of the period,
 * so that it holds all along it where a u + b >= 0 and q(u) >= 0. Each round takes one step of
 * Newton's method: the constraints are linearised, and the QP proposes another input. On the line
 * through both inputs all constraints are known in closed form, and the step ends at the nearest
 * input at which all of them hold, or else where their squared violations are least among their
 * roots and vertices and what the QP proposed. So for one input one step finds the nearest one;
 * several end at one that has been checked, which need not be the nearest.
 */
static bool hold_for_period(
    decision *d, const real *a, int width, const real *b, const real *forms)
{
    held_row rows[HELD];
    real changes[SAMPLED * LINE], slopes[HELD * INPUTS], offsets[HELD];
    real value[HELD], priority[HELD], target[INPUTS], margin[HELD];
    bool missed[HELD] = {false}, active[HELD], finite = true;
    const real *change = changes;
    int count = CONSTRAINTS;
    change_values(d->x, changes);
    for (int i = 0; i < CONSTRAINTS; i++) {
        rows[i] = (held_row){i, {b[i]}, {0}};
        for (int j = 0; j < INPUTS; j++) {
            rows[i].line[1 + j] = a[i * width + j];
        }
        for (int e = 0; forms && e < 3; e++) {
            rows[i].form[e] = forms[3 * i + e];
        }
        if (!kinds[i].sampled) {
            continue;
        }
        held_row *row = rows + count++;
        *row = rows[i];
        row->form[0] = row->form[1] = row->form[2] = 0;
        if (d->inside[i] && d->known[i]) {
            const real fall = period * change[0];
            row->line[0] += fall - INWARDS * (ABS(row->line[0]) + ABS(fall));
            for (int e = 1; e < LINE; e++) {
                row->line[e] += period * change[e];
            }
        }
        change += LINE;
        finite = finite && isfinite(sum_of(LINE, row->line));
    }
    for (int i = 0; i < count; i++) {
        priority[i] = slack_weight[rows[i].owner];
    }
    const qp p = {count, INPUTS, slopes, offsets, d->u, d->low, d->high, input_weight, priority};
    d->feasible = constraints_hold(rows, d->u, slopes, offsets, value, missed);
    for (int round = 0; round < ROUNDS && !d->feasible; round++) {
        (void)project(&p, target, margin, active);
        real left = move_on_line(rows, d, d->u, target);
#if INPUTS > 1
        for (int j = 0; left > SLOW && j < INPUTS; j++) {
            for (int n = 0; n < INPUTS; n++) {
                target[n] = d->u[n] + (real)(n == j);
            }
            left *= move_on_line(rows, d, d->u, target);
        }
#endif
        d->feasible = constraints_hold(rows, d->u, slopes, offsets, value, missed);
        if (!(left < ENOUGH)) {
            break;
        }
    }
    for (int i = 0; i < count; i++) {
        const int owner = rows[i].owner;
        d->margin[owner] = i < CONSTRAINTS ? value[i] : smaller(d->margin[owner], value[i]);
        d->active[owner] = d->active[owner] || missed[i];
    }
    return finite;
}
#endif

/* Solve the QP of a decision; return whether all its numbers are finite. */
static bool minimise(decision *d)
{
    const real *a = d->values, *b = d->asked, *low = d->low, *high = d->high;
    bool finite = true;
    real aim[COLUMNS] = {0};
    for (int j = 0; !GOAL && j < INPUTS; j++) {
        aim[j] = d->wanted[j];
    }
#if RECIPROCAL
    aim_outwards(d, aim);
#endif
#if RECIPROCAL || UNCERTAIN || GOAL
    real rows[(CONSTRAINTS + GOAL) * COLUMNS] = {0}, offsets[CONSTRAINTS + GOAL];
    for (int i = 0; i < CONSTRAINTS; i++) {
        for (int j = 0; j < INPUTS && d->inside[i]; j++) {
            rows[i * COLUMNS + j] = a[i * INPUTS + j];
        }
        offsets[i] = b[i];
    }
#if UNCERTAIN
    const real *q = d->values + FORMS;
#if INTERVALS
    real forms[3 * CONSTRAINTS] = {0};
#endif
    for (int i = 0; i < CONSTRAINTS; i++) {
        if (kinds[i].uncertain) {
            real form[FORM];
            for (int e = 0; e < FORM; e++) {
                form[e] = d->known[i] ? q[e] : 0;
            }
            finite = finite && isfinite(sum_of(FORM, form));
#if INTERVALS
            for (int e = 0; e < FORM; e++) {
                forms[3 * i + e] = form[e];
            }
#else
            take_plane(d, form, rows + i * COLUMNS, offsets + i);
#endif
            q += FORM;
        }
    }
#endif
#if GOAL
    real lower[COLUMNS], upper[COLUMNS];
    goal_row(d, rows + CONSTRAINTS * COLUMNS, offsets + CONSTRAINTS, lower, upper);
    low = lower;
    high = upper;
#endif
    a = rows;
    b = offsets;
#endif
    const qp p = {CONSTRAINTS + GOAL, COLUMNS, a, b, aim, low, high, input_weight, slack_weight};
#if INTERVALS
    d->feasible = project_interval(&p, forms, d->u, d->margin, d->active);
#else
    d->feasible = project(&p, d->u, d->margin, d->active);
#endif
#if GOAL
    /* The goal's constraint, which can always be met, has no say in that, nor has its rounding. */
    d->feasible = true;
    for (int i = 0; i < CONSTRAINTS; i++) {
        real allowed;
        d->feasible = d->feasible && residual(&p, i, d->u, &allowed) >= -allowed;
    }
#endif
#if SAMPLED && INTERVALS
    finite = hold_for_period(d, a, COLUMNS, b, forms) && finite;
#elif SAMPLED
    finite = hold_for_period(d, a, COLUMNS, b, NULL) && finite;
#endif
    return finite;
}

/* Return the active constraint whose half-space is furthest from what is wanted, or -1.
 *
 * A reciprocal one outside its domain is further than any, and one that says nothing of the input
 * nearer than any; of several such, the first counts.
 */
static int furthest_constraint(const decision *d)
{
    int cause = -1;
    real most = 0;
    if (CONSTRAINTS == 1) {
        return d->active[0] ? 0 : -1;
    }
    for (int i = 0; i < CONSTRAINTS; i++) {
        if (d->active[i]) {
            const real nearest = -(real)INFINITY, *a = d->values + i * INPUTS;
            real distance = distance_to_row(a, d->asked[i], d->wanted, nearest);
            if (!d->inside[i] && distance > nearest) {
                distance = (real)INFINITY;
            }
            if (cause < 0 || distance > most) {
                cause = i;
                most = distance;
            }
        }
    }
    return cause;
}

/* Decide at d->x within d->low and d->high, for what is proposed in d->wanted.
 *
 * Return whether the constraints and the goal have finite values.
 */
static bool decide(decision *d)
{
    bool finite = true;
    constraint_values(d->x, d->values);
    for (int i = 0; i < CONSTRAINTS; i++) {
        d->known[i] = d->inside[i] = true;
    }
#if PARTIAL
    const real *height = d->values + HEIGHTS;
    for (int i = 0; i < CONSTRAINTS; i++) {
        if (kinds[i].partial) {
            real *a = d->values + i * INPUTS, *b = d->values + OFFSETS + i;
            d->known[i] = isfinite(*height++ + sum_of(INPUTS, a) + *b);
            for (int j = 0; j < INPUTS && !d->known[i]; j++) {
                a[j] = 0;
            }
            *b = d->known[i] ? *b : 0;
        }
    }
#endif
#if GOAL
    finite = finite && isfinite(sum_of(INPUTS + 1, d->values + GROWTH));
    pursue(d);
#endif
#if MAXIMA
    finite = choose_functions(d) && finite;
#endif
    if (!(finite && (ONLY_ONE || isfinite(sum_of(OFFSETS + CONSTRAINTS, d->values))))) {
        return false;
    }
    for (int i = 0; i < CONSTRAINTS; i++) {
        d->asked[i] = d->values[OFFSETS + i];
    }
#if RECIPROCAL
    real demands[RECIPROCAL], *demand = demands;
    const real *level = d->values + LEVELS;
    demand_values(d->x, demands);
    for (int i = 0; i < CONSTRAINTS; i++) {
        if (kinds[i].domain) {
            for (int c = 0; c < kinds[i].domain; c++) {
                d->inside[i] = d->inside[i] && level[c] > 0;
            }
            level += kinds[i].domain;
            d->inside[i] = d->inside[i] || !d->known[i];
            d->asked[i] = d->inside[i] && d->known[i] ? d->asked[i] - *demand : 0;
            demand++;
        }
    }
#endif
    finite = minimise(d) && finite;
    for (int i = 0; i < CONSTRAINTS; i++) {
        if (!d->inside[i]) { /* all that is left is the rate of h */
            d->margin[i] = dot(INPUTS, d->values + i * INPUTS, d->u) + d->values[OFFSETS + i];
            d->active[i] = true;
            d->feasible = false;
        }
    }
    const real total = ONLY_ONE ? 0 : sum_of(INPUTS, d->u);
    finite = finite && isfinite(total + sum_of(CONSTRAINTS, d->margin));
    for (int i = 0; i < CONSTRAINTS; i++) {
        if (!d->known[i]) { /* a barrier without a value is not safe */
            d->margin[i] = -(real)INFINITY;
            d->active[i] = true;
            d->feasible = false;
        }
    }
    return finite;
}

#if UNITS
/* Fully connected layers, which end in numbers without activation. */
typedef struct {
    int layers;
    const int *sizes;    /* of the input and of each layer */
    bool rectified;      /* whether units are rectified linear ones, else tanh */
    const real *numbers; /* of each layer: weights, a row for each of its inputs, and biases */
} network;

/* Write the units of the first layers one after the other, the inputs before them.
 *
 * Return where the last ones are. All are NaN where an input is not finite, which saturated units
 * would hide.
 */
static real *forward(const network *n, int layers, const real *inputs, real *units)
{
    const bool finite = isfinite(sum_of(n->sizes[0], inputs));
    const real *weights = n->numbers;
    for (int j = 0; j < n->sizes[0]; j++) {
        units[j] = finite ? inputs[j] : (real)NAN;
    }
    for (int k = 0; k < layers; k++) {
        const int count = n->sizes[k], size = n->sizes[k + 1];
        const real *biases = weights + count * size;
        real *next = units + count;
        for (int i = 0; i < size; i++) {
            next[i] = biases[i];
        }
        for (int j = 0; j < count; j++) {
            for (int i = 0; i < size; i++) {
                next[i] += units[j] * weights[j * size + i];
            }
        }
        for (int i = 0; i < size && k + 1 < n->layers; i++) {
            next[i] = !n->rectified ? TANH(next[i]) : next[i] < 0 ? 0 : next[i];
        }
        weights = biases + size;
        units = next;
    }
    return units;
}

/* Write the outputs of a network. */
static void network_outputs(const network *n, const real *inputs, real *outputs)
{
    real units[UNITS];
    const real *last = forward(n, n->layers, inputs, units);
    for (int i = 0; i < n->sizes[n->layers]; i++) {
        outputs[i] = last[i];
    }
}

/* Write the slopes of the first output of a network along its inputs. */
HELPER void network_slopes(const network *n, const real *inputs, real *slopes)
{
    real units[UNITS], change[UNITS];
    const real *last = forward(n, n->layers - 1, inputs, units);
    const real *weights = n->numbers;
    for (int k = 0; k < n->layers - 1; k++) {
        weights += (n->sizes[k] + 1) * n->sizes[k + 1];
    }
    int size = n->sizes[n->layers - 1];
    for (int i = 0; i < size; i++) {
        change[i] = weights[i * n->sizes[n->layers]];
    }
    for (int k = n->layers - 2; k >= 0; k--) {
        const int count = n->sizes[k];
        weights -= (count + 1) * size;
        for (int i = 0; i < size; i++) {
            /* A value that is NaN makes the slope NaN. */
            const real y = last[i];
            change[i] *= !n->rectified ? 1 - y * y : y > 0 ? 1 : y * 0;
        }
        for (int j = 0; j < count; j++) {
            slopes[j] = 0;
            for (int i = 0; i < size; i++) {
                slopes[j] += change[i] * weights[j * size + i];
            }
        }
        for (int j = 0; j < count; j++) {
            change[j] = slopes[j];
        }
        size = count;
        last -= count;
    }
}
#endif

#else
typedef int filter_core_is_included_in_filter_c; /* no file may be empty */
#endif
