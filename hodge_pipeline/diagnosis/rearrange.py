"""An alignment improved by moving whole blocks of views to where more speaks for them, until none wants to move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.blocks import cut_blocks
from hodge_pipeline.diagnosis.pieces import Alignment
from hodge_pipeline.diagnosis.placement import Scene
from hodge_pipeline.types import Bools, Floats, Ints

ROUNDS = 5
TRIED = 5
"""Places of a block in each piece, by how many edges agree on them."""
SAME_PLACE = 0.3
LEAST_GAIN = 0.1
ALIKE = 8.0
"""Two edges agree on a place within so many times their noise."""


@dataclass(frozen=True)
class _Place:
    """A piece, and the motion (4, 4) that takes the block there."""

    piece: int
    motion: Floats


def rearrange(scene: Scene, alignment: Alignment, whole_pieces: bool = False) -> Alignment:
    """The alignment after the moves; with `whole_pieces` none is cut, pieces are only laid against each other."""
    poses, piece = alignment.piece_from.copy(), alignment.piece.copy()
    edges = scene.evidence.edges
    every = np.arange(len(edges))
    for _ in range(ROUNDS):
        same = piece[edges[:, 0]] == piece[edges[:, 1]]
        weight = np.where(same, scene.agreement(poses, every), 0.0)
        piece = connected_components(edges[weight > 0], len(piece))
        blocks = cut_blocks(edges, weight, piece)
        if whole_pieces:
            blocks = [np.flatnonzero(piece == number) for number in range(int(piece.max(initial=-1)) + 1)]
        moved = [_move(scene, block, poses, piece) for block in blocks]
        if not any(moved):
            break
    same = piece[edges[:, 0]] == piece[edges[:, 1]]
    agreeing = same & (scene.agreement(poses, every) > 0)
    return Alignment(connected_components(edges[agreeing], len(piece)), poses)


def _move(scene: Scene, block: Ints, poses: Floats, piece: Ints) -> bool:
    """Whether the block was moved, in place."""
    own = piece[block[0]]
    edges = scene.evidence.edges
    inside = np.zeros(len(piece), bool)
    inside[block] = True
    leaving = np.flatnonzero(inside[edges[:, 0]] != inside[edges[:, 1]])
    if not len(leaving) or (piece[block] != own).any():
        return False
    rest = np.flatnonzero((piece == own) & ~inside)
    now = _value(scene, block, rest, leaving, inside, poses, piece, int(own)) if len(rest) else 0.0
    best, chosen = 0.0, None
    for place in _places(scene, leaving, inside, poses, piece, int(own)):
        there = np.flatnonzero((piece == place.piece) & ~inside)
        trial = poses.copy()
        trial[block] = place.motion @ trial[block]
        value = _value(scene, block, there, leaving, inside, trial, piece, place.piece)
        if value > best:
            best, chosen = value, place
    if best <= now + LEAST_GAIN:
        return False
    if chosen is None:
        piece[block] = piece.max() + 1
    else:
        poses[block] = chosen.motion @ poses[block]
        piece[block] = chosen.piece
    return True


def _value(
    scene: Scene, block: Ints, there: Ints, leaving: Ints, inside: Bools, poses: Floats, piece: Ints, number: int
) -> float:
    ends = scene.evidence.edges[leaving]
    outer = np.where(inside[ends[:, 0]], ends[:, 1], ends[:, 0])
    return scene.value(poses, block, there, leaving[piece[outer] == number])


def _places(scene: Scene, leaving: Ints, inside: Bools, poses: Floats, piece: Ints, own: int) -> list[_Place]:
    """Where the edges that leave the block would have it, those first on which most agree."""
    evidence = scene.evidence
    i, j = evidence.edges[leaving].T
    forward, backward = evidence.i_from_j[leaving], se3.inverse(evidence.i_from_j[leaving])
    turned = inside[i]
    inner, outer = np.where(turned, i, j), np.where(turned, j, i)
    motion = poses[outer] @ np.where(turned[:, None, None], backward, forward) @ se3.inverse(poses[inner])
    at, found = poses[inner, :3, 3], []
    for number in np.unique(piece[outer]).tolist():
        rows = np.flatnonzero(piece[outer] == number)
        alike = _alike(motion[rows], at[rows], *(s[leaving[rows]] for s in _noise(scene)))
        taken: list[int] = []
        for row in np.argsort(-alike.sum(axis=1), kind="stable").tolist():
            if len(taken) == TRIED:
                break
            if any(alike[row, other] > SAME_PLACE for other in taken):
                continue
            taken.append(row)
            mean = _mean(motion[rows], at[rows], alike[row])
            if number != own or not _stays(mean, at[rows], scene):
                found.append(_Place(number, mean))
    return found


def _noise(scene: Scene) -> tuple[Floats, Floats]:
    return scene.evidence.noise.rotation_rad, scene.evidence.noise.translation_m


def _alike(motion: Floats, at: Floats, turn: Floats, shift: Floats) -> Floats:
    """From 1 to 0 (N, N) how well the second motion agrees with the first, at the second's view."""
    landed = np.einsum("nij,nj->ni", motion[:, :3, :3], at) + motion[:, :3, 3]
    moved = np.einsum("mij,nj->mni", motion[:, :3, :3], at) + motion[:, None, :3, 3] - landed[None]
    trace = motion[:, :3, :3].reshape(-1, 9) @ motion[:, :3, :3].reshape(-1, 9).T
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    far = np.linalg.norm(moved, axis=2) / (ALIKE * np.hypot(shift[:, None], shift[None]))
    wide = angle / (ALIKE * np.hypot(turn[:, None], turn[None]))
    return np.asarray(np.maximum(0.0, 1 - far**2) * np.maximum(0.0, 1 - wide**2))


def _mean(motion: Floats, at: Floats, weight: Floats) -> Floats:
    share = weight / weight.sum()
    rotation = se3.project_to_so3(np.einsum("n,nij->ij", share, motion[:, :3, :3])[None])[0]
    landed = share @ (np.einsum("nij,nj->ni", motion[:, :3, :3], at) + motion[:, :3, 3])
    return se3.from_parts(rotation, landed - rotation @ (share @ at))


def _stays(motion: Floats, at: Floats, scene: Scene) -> bool:
    moved = at @ motion[:3, :3].T + motion[:3, 3] - at
    turned = np.linalg.norm(motion[:3, :3] - np.eye(3))
    return bool(turned < SAME_PLACE and np.linalg.norm(moved, axis=1).max() < SAME_PLACE * scene.evidence.reach_m)
