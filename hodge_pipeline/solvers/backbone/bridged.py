"""Loops judged on a chain that may be broken: a step is bridged where the loops then say much more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline.solvers.backbone.breaks import Break, Testimony, Usual, agreed_breaks, unusual_breaks
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.fit import linearise
from hodge_pipeline.solvers.backbone.inference import BY_CHANCE, Inferred, by_chance, infer
from hodge_pipeline.solvers.backbone.scales import mixture
from hodge_pipeline.types import Bools

MOST_BREAKS, MOST_TRIED = 10, 2
"""That are bridged one after the other, and that are tried each time."""


def infer_bridged(chain: Chain, always: Bools, most_unknowns: int | None) -> tuple[Chain, Inferred] | None:
    """The chain with its broken steps bridged, and its loops judged; None as in `infer`.

    A step is tried where loops of several places agree that it is broken, or where it is unlike all others. It is
    broken where all loops are likelier with a bridge in its place: by more than chance would have them be.
    """
    found = infer(chain, always, most_unknowns)
    for _ in range(MOST_BREAKS):
        better = None if found is None else _better(chain, found, always, most_unknowns)
        if better is None:
            break
        chain, found = better
    return None if found is None else (chain, found)


def _better(chain: Chain, found: Inferred, always: Bools, most_unknowns: int | None) -> tuple[Chain, Inferred] | None:
    """The chain with one more step bridged, and its loops judged; None where it has none that is broken."""
    for broken, least in _candidates(chain, found):
        tried = bridged(chain, broken)
        other = infer(tried, always, most_unknowns)
        if other is not None and other.log_evidence > found.log_evidence + least:
            return tried, other
    return None


def _candidates(chain: Chain, found: Inferred) -> list[tuple[Break, float]]:
    """Breaks worth a trial, with what each must win; one that is unlike all others has won some of it."""
    scaled = found.scales.applied(chain)
    linear, (right, wrong) = linearise(scaled, chain.poses()), found.judged.log_density
    shares = np.log(mixture(found.judged.log_density)[0])
    told = Testimony.of(scaled, linear, np.logaddexp(shares[0] + right - wrong, shares[1]), wrong)
    usual, least, fold = Usual.of(chain), by_chance(len(right)), np.log(max(len(right), 1))
    agreed = [each for each in agreed_breaks(told, usual) if each.log_evidence > BY_CHANCE + fold]
    unlike = [each for each in unusual_breaks(usual) if each.log_evidence > BY_CHANCE]
    worth = [(each, least) for each in agreed[:MOST_TRIED]]
    return worth + [(each, max(least - each.log_evidence, BY_CHANCE)) for each in unlike]


def bridged(chain: Chain, broken: Break) -> Chain:
    """The chain with another motion in place of a step."""
    step, covariance, known = chain.step.copy(), chain.step_covariance.copy(), chain.bridged.copy()
    step[broken.at], covariance[broken.at], known[broken.at] = broken.motion, broken.covariance, True
    return replace(chain, step=step, step_covariance=covariance, bridged=known)
