"""What evidence and its fit are set to, along routes and over areas.

Each group names what it was chosen on; `drives`, `ends` and `areas` are commands of ``python -m benchmarks``.
Values without a command were found on recorded drives before there was one. What half and double of each do
to whole drives of thirteen routes, ``python -m benchmarks chosen data/`` tells: benchmarks/results/ends.md.
"""

from __future__ import annotations

from fractions import Fraction

# Evidence: how queries depend on each other, and what a score says; on recorded drives, later on `drives`.
SMALLEST = 0.05  # autocorrelation of descriptors at which the sum over lags ends, which is tau
SHARPENED = 0.6  # tau' = SHARPENED tau queries count as one
UNCHANGED = 0.05  # of a typical step: the queries of a stop differ less than that from its first
STOP = 20  # queries of a stop; in a shorter one, as where frames repeat in the dark, the camera may move
RADIUS = 5  # places around a right one whose scores are not counted as wrong
MIN_SEPARATION = 0.3  # standard deviations of normal scores between right and wrong ones, at least

# Pictures that repeat, and waits: on those of `ends`, of eight routes.
ROUNDING = 1e-5  # of a descriptor, by which those of one picture differ in other batches
WAIT = 21  # queries in a row that show a wait
# squares of its steps over its variance, at least, and of the largest one, at most; and its variance over the
# squared distance of unlike queries
NOISE, JUMP, ALIKE = 1.9, 8.0, 0.35

# How near queries come to the map: on nine routes of `ends` (both laps, both corridors, floors, city 1 and 3,
# first halves of railway and road); `TAIL` also on the road's second half and sim:underground, since the road
# lost by the others
TAIL = 5  # degrees of freedom of the best scores of queries that are on the map
NEAREST = 0.1, 0.4  # quantiles of the best scores of queries, from which those on the map are known
MOST_ABSENT, MOST_PRESENT = 5.0, 1.0  # nats that a query's best score tells of being off, and on, the map
KNOWN = 20  # queries, and mirrored ones, from which on a filter knows it
FILTERED = 2.0  # of a filter's queries say as much as one: 4 and 2 were compared on all routes of `ends`
# Of an exported filter, which has no calibration beside it: bins of its histogram, and by how many scales
# `off` has to lie beyond `on`: 0, .3, .5 and .75 were compared on eleven routes of `ends`
BINS, STANDS_APART = 128, 0.5

# The fit: priors, and what they count as; on recorded drives, later on `drives`.
ROUNDS = 5  # of expectation-maximisation
MOVES = (0.2, 0.5, 0.2, 0.05, 0.02, 0.015, 0.015)  # one place a query, in the mean
SLOW = (0.67, 0.25, 0.05, 0.01, 0.01, 0.005, 0.005)  # of which it starts if that at one place a query fails
FAST = (0.05, 0.1, 0.2, 0.3, 0.2, 0.1, 0.05)
RATES = 0.001, 0.001, 0.01  # jump, leave, enter
MOVE_SHARE = 0.1  # of the queries: the weight of the prior of the moves
RATE_COUNTS, ENTER_COUNTS = 200.0, 50.0  # steps that the priors of jump and leave, and of enter, count as
# nats above being off the map by which another speed is taken, in all and per query, and times as many as at
# one place a query: with 1 in place of 5, short stretches in random order are taken for a fast drive
OTHER_SPEED, PER_QUERY, CLEARLY = 30.0, 0.1, 5.0

# The queries that are fitted to, for time.
FITTED, STRETCH, STRETCHES = 1000, 100, 10  # at most; queries in a stretch, and stretches
FEWEST_FITTED, SAMPLED = 20, 2**21  # at least; and their scores at most otherwise
CORRELATED = 4  # correlation times in a stretch, at least

# Steady speeds, on `storage --drives` at half a byte and on `drives`, of city 1, corridor, gardens, laps,
# lidar and the railway's first half. There is none of 0: the queries of a stop are alike, and where they are
# not, a stretch of places that look alike would pass for one.
STEADY = tuple(map(Fraction, ("1/3", "1/2", "1", "3/2", "2", "3", "5")))  # places a query
SLIP = 0.04  # share of the moves that are a place more or less
KEEPS, TO_NEXT, STAYS_FREE = 0.98, 0.6, 0.9  # a speed is kept; else the next ones follow; free motion goes on
CHANGE_COUNTS, ASKED = 30.0, 300  # what these count as, each; queries that tell which speeds occur
SELDOM = 0.2  # share of the queries at which a speed does not occur
# Of a filter, which cannot learn them: on eleven routes of `drives`, five of them also at half a byte, and
# six simulated ones, as they were, backwards, and one query in two and three.
LIVE, KEEPS_LIVE = STEADY[1:-1], 0.99
USUAL, BACK = 0.4, 0.1  # shares of the cameras that pass place by place; against the order of the places

# Odometry: the share of the places that it misses, or counts twice; .1, .2 and .3 were compared with odometry
# made from the truth of twelve routes of `drives`, 10 % of noise or 10 % too large: noise asks for less.
ODOMETRY = 0.1
PACES = tuple(0.25 * 1.2**i for i in range(18))  # places a query, one of which odometry in metres shows
SCALES = 1.0, 0.95, 1.05, 0.9, 1.1, 0.85, 1.15  # of which a whole drive shows one

# Over areas, on `areas`: among so many windows a right one has to stand out more than along a route.
FLIGHT_SEPARATION, LEAST_FLIGHT_SEPARATION = 3.0, 1.0  # standard deviations of scores
SPREADS = 2.0, 0.7, 4.0  # windows that a step goes in each direction, and where that explains little
FLIGHT_FITTED = 300  # queries in a row, from the middle
# Headings, which answers know and the fit does not, up to so many states of the queries of a block; how
# narrow they are, and the share that keeps one: on seed 0 of `areas`
HEADINGS, MOST_STATES, COURSE, KEEPS_COURSE = 8, 2**24, 8.0, 0.92

# Answers, on recorded drives.
DOUBT = 0.1  # nats for each deviation by which an answer's own score is worse than is usual in the drive
