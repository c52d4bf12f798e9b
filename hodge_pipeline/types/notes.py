"""Facts that a run reports: they travel as values, and become sentences where a person reads them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum


class Rank(IntEnum):
    """How much a reader should heed a note: it puts the result in doubt, needs a look, or only informs."""

    DOUBT = 0
    LOOK = 1
    FACT = 2


WORDING: dict[str, tuple[Rank, str]] = {
    # What stages report in their own words.
    "reader": (Rank.FACT, "{detail}"),
    "reader's doubt": (Rank.LOOK, "{detail}"),
    "clouds": (Rank.FACT, "{detail}"),
    "start": (Rank.FACT, "{detail}"),
    "measured": (Rank.FACT, "{detail}"),
    "solver": (Rank.FACT, "{detail}"),
    "fuser": (Rank.FACT, "{detail}"),
    "recording": (Rank.FACT, "{detail}"),
    "refinement": (Rank.FACT, "{detail}"),
    # What a run does.
    "input changed": (
        Rank.DOUBT,
        "{count} files of the input changed while the run read them ({detail}): run the same command again once they "
        "stay as they are.",
    ),
    "single frame": (
        Rank.LOOK,
        "{detail}: has a single frame: there is nothing to register, the model is that frame alone",
    ),
    "option unknown": (Rank.LOOK, "{detail}; made by another version: it is left out of what is shown"),
    "ambiguous": (
        Rank.DOUBT,
        "{count} of {detail} pairs fit in several ways, as in a bare room, and join nothing: take scans in between, "
        "with furniture or targets in sight.",
    ),
    "scale": (Rank.LOOK, "{detail}"),
    "depth unit": (Rank.DOUBT, "Depth is probably not in metres: {detail}."),
    "depth steps": (
        Rank.LOOK,
        "depth is another sensor's than a Kinect, Xtion, Astra or Structure sensor, or in another unit: {detail}",
    ),
    "depth range": (Rank.LOOK, "{detail}: is the depth scale right (source.reader.depth_scale)?"),
    "given poses": (Rank.FACT, "{count} of {detail} poses given"),
    "given file": (Rank.FACT, "{detail}"),
    "key frames": (
        Rank.FACT,
        "{count} of {detail} frames are key frames: these are registered, the others move as those around them",
    ),
    "tracking lost": (
        Rank.LOOK,
        "tracking was lost at {count} frames ({detail}): their poses lie between their neighbours'",
    ),
    "blank images": (
        Rank.LOOK,
        "{count} frames have depth, but a colour image that shows nothing, black or of one even colour ({detail}): "
        "surfaces alone place them",
    ),
    "moving objects": (
        Rank.LOOK,
        "much of {count} frames moved otherwise than the camera ({detail}): people or objects that move? The camera's "
        "motion is the one that fits more of the image; key frames leave out what moves",
    ),
    "camera or object": (
        Rank.DOUBT,
        "The path may in part be that of objects: in {count} of {detail}, more than a quarter of the image "
        "moves otherwise than the camera is said to. Compare the model with the scene, or leave these frames out.",
    ),
    "unheld": (
        Rank.DOUBT,
        "The path may slide: at {count} of {detail} what both frames see, such as a bare wall, does not hold the "
        "camera in every direction, and no other edge tests the step.",
    ),
    "other scale": (
        Rank.DOUBT,
        "The true path is {detail} times as large as this one: depth is read in the wrong unit (--set "
        "source.reader.depth_scale), or with another camera's focal length, or the truth is not in metres, or not of "
        "the camera.",
    ),
    "clock": (
        Rank.LOOK,
        "the clock goes back at {detail}: the step there counts as long as the usual one",
    ),
    "holes": (
        Rank.LOOK,
        "the recording stops for {detail}: what the frames on both sides share tells the motion there",
    ),
    "path broken": (
        Rank.LOOK,
        "tracking was lost for good in {count} places: {detail} pieces of the path begin anew",
    ),
    "slid": (
        Rank.LOOK,
        "odometry slid unnoticed at {count} frames ({detail}): the pairs over these steps agree on where they lead, "
        "and count in its place",
    ),
    "sweeps left out": (
        Rank.LOOK,
        "{count} sweeps are left out, and posed by their neighbours where these are known; the first: {detail}",
    ),
    "sweeps loose": (
        Rank.LOOK,
        "{count} of {detail} sweeps tell little of how far the scanner went, as in a tunnel, and it goes on as before",
    ),
    "path loose": (
        Rank.DOUBT,
        "The length of the path is in doubt: {count} of {detail} sweeps tell little of how far the scanner went, as on "
        "a bare field, and it goes on as before there. Known positions (positions.path) would hold it.",
    ),
    "sweeps untimed": (
        Rank.FACT,
        "the points of the sweeps have no times (t, time, timestamp): each is taken as measured in an instant",
    ),
    "readout": (
        Rank.FACT,
        "the camera's read-out (rolling shutter), estimated: {detail}; readout_s in the camera's file would be exact",
    ),
    "misfits": (
        Rank.LOOK,
        "{count} frames fit nothing that their key frame saw ({detail}): their poses follow from its own",
    ),
    "truth": (Rank.FACT, "{count} of {detail} frames have a true pose, by the truth that was named"),
    "no truth near": (Rank.LOOK, "{detail}: no pose has a true one near in time: its error is not measured"),
    "carried": (Rank.LOOK, "{count} frames without a given pose are carried from the nearest ones by odometry"),
    "revisits": (
        Rank.FACT,
        "{count} pairs close loops along the path, before the first round: odometry's poses move by up to {detail}",
    ),
    "left apart": (Rank.LOOK, "nothing joins what tracking left apart: it starts where the guessed motion puts it"),
    "positions of no frame": (
        Rank.FACT,
        "{count} of {detail} known positions are of no frame, or another is nearer to theirs in time.",
    ),
    "world": (
        Rank.FACT,
        "The result is in the world of {count} known positions, east, north, up: its zero is {detail}.",
    ),
    "positions rejected": (
        Rank.LOOK,
        "{count} known positions are rejected: the others contradict them by more than 5 sigma: {detail}",
    ),
    "not placed": (Rank.DOUBT, "{detail}"),
    "positions scatter": (
        Rank.LOOK,
        "Known positions scatter {detail} times as far as their sigma says: a clock that is off, or an antenna away "
        "from the sensor (positions.antenna_m), looks like that.",
    ),
    "left out": (
        Rank.FACT,
        "{detail}: {count} edges that the diagnosis calls wrong or suspect are left out of the solve",
    ),
    "matched": (Rank.FACT, "{count} pairs between pieces matched, {detail}"),
    "suggested": (Rank.FACT, "{detail}"),
    "no decomposition": (Rank.LOOK, "{detail}"),
    "scores of before": (
        Rank.FACT,
        "the scores are not measured again after an edit: hodge run, as before, measures them",
    ),
    "fused key frames": (
        Rank.FACT,
        "fused after an edit: the {count} key frames alone; hodge run, as before, fuses all frames",
    ),
    "damaged step": (Rank.LOOK, "{detail}: the step is computed again"),
    "without images": (Rank.LOOK, "recorded without images: {detail}"),
    # Edits and refinements.
    "edited": (Rank.FACT, "edited by hand: {detail}"),
    "edit lost": (Rank.LOOK, "edits without effect, since the last round has no such edge: {detail}"),
    "edit rejected": (Rank.LOOK, "{detail}"),
    "guard": (Rank.FACT, "{detail}"),
    "held out": (Rank.FACT, "{count} overlapping pairs were kept out of the solve: clouds there {detail}"),
    "nothing held out": (
        Rank.LOOK,
        "no overlapping pair was left to judge the result by: only the edges' own chi2 does",
    ),
    "other format": (Rank.LOOK, "poses are not written back into {detail}: refined.tum holds them"),
    # What a report finds.
    "unsettled": (
        Rank.DOUBT,
        "The result is not to be trusted: the last round still moved the cameras by {detail}, so the registered pairs "
        "do not agree on one scene. Frames nearer to each other, or more texture, would help.",
    ),
    "parts": (
        Rank.DOUBT,
        "The viewing graph falls into {count} parts that nothing connects: their poses relative to each other mean "
        "nothing.",
    ),
    "alone": (Rank.LOOK, "{count} of {detail} frames have no edge at all: they keep the pose they started with."),
    "edges ignored": (Rank.FACT, "The solver ignored {count} of {detail} edges (weight 0)."),
    "wrong": (Rank.LOOK, "{count} of the edges used are judged wrong, {detail}: hodge diagnose shows them."),
    "harmless": (Rank.FACT, "{count} of the edges used are judged wrong, {detail}: nothing to do."),
    "suspect": (Rank.FACT, "{count} of the edges used are suspect: hodge diagnose shows them."),
    "above truth": (
        Rank.FACT,
        "The clouds lie closer together at the result than at the true poses: a score measures how well clouds fit, "
        "and the noise of depth, or an error of the truth, moves the best fit away from it. Errors of the "
        "trajectory do not depend on that.",
    ),
    "untestable": (
        Rank.LOOK,
        "{count} of {detail} edges are untestable: nothing in the graph says whether they are right.",
    ),
    "edges far off": (
        Rank.FACT,
        "At least {count} edges that the solver used are more than {detail} off the result: see the worst edges.",
    ),
    "unmatched": (Rank.LOOK, "{detail} of each other."),
    "not in the error": (
        Rank.FACT,
        "{detail}: {count} without a true pose, or joined to no other, are not in the error.",
    ),
    "degenerate": (
        Rank.FACT,
        "{detail}: its positions lie on a line (or are fewer than three): its orientations aligned it.",
    ),
    "no metres": (
        Rank.LOOK,
        "There is no depth that tells the scale: lengths are in the model's own unit.",
    ),
}
"""Each kind's rank, and its sentence: `{count}` and `{detail}` are the note's."""


@dataclass(frozen=True)
class Note:
    """A fact of a run: its kind (see `WORDING`), how many it concerns, and what in particular; `str` gives the
    sentence.
    """

    kind: str
    count: int = 1
    detail: str = ""

    def __post_init__(self) -> None:
        if self.kind not in WORDING:
            raise ValueError(f"'{self.kind}' is no kind of note: use {', '.join(WORDING)}")

    def __str__(self) -> str:
        return WORDING[self.kind][1].format(count=self.count, detail=self.detail)

    @property
    def rank(self) -> Rank:
        """How much a reader should heed it."""
        return WORDING[self.kind][0]


def notes_of(kind: str, details: Iterable[str]) -> tuple[Note, ...]:
    """A note of one kind for each of these details, which are sentences of a stage."""
    return tuple(Note(kind, detail=detail) for detail in details)
