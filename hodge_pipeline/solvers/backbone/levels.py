"""Levels that several questions of the backbone and of the diagnosis share."""

from __future__ import annotations

MOST_ROUNDS = 15
"""Rounds of an iteration that ends when it settles: a limit on cost."""
MOST_TRIED = 3
"""Candidates that are tried of each kind, the likeliest, and times that a judgement is repeated: a limit on cost."""
FEWEST = 10
"""Fewest values of which the median tells a scale, to a fifth."""
NEARLY_ALL = 0.9
"""Share of values that must be as a rule says, for it to hold."""
RANDOM = 4000
"""Random pairs of places, from which distributions by chance are known to a few hundredths."""
SIGMAS = 3.0
"""Standard deviations, or usual errors, beyond which an error is no chance: a normal one in 400."""
SINGULAR = 1e-6
"""Share of a variance below which it is none: rounding, or an axis along which nothing moves."""
TOLERANCE = 1e-4
"""Relative tolerance of χ² of solves that only judge edges."""
