"""Notes: facts that a run reports, which travel as values and become sentences where a person reads them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

from hodge_pipeline.types.text import suiting


class Rank(IntEnum):
    """How grave a note is: the input may be wrong; the result is in doubt; something needs a look; it only informs."""

    INPUT = 0
    DOUBT = 1
    LOOK = 2
    FACT = 3


INPUTS = {
    "input changed": "{count} {count:file|files} of the input changed while the run read {count:it|them} ({detail}): "
    "run the same command again once {count:it stays as it is|they stay as they are}.",
    "images missing": "{count} of {detail} are missing: unpack or copy the whole sequence",
    "colour unpaired": "{count} of {detail} depth images have no colour image of their time or number, although there "
    "are colour images: are both stamped by one clock (source.reader.max_difference_s), or numbered alike?",
    "reader's doubt": "{detail}",
    "depth unit": "Depth is probably not in metres: {detail}.",
    "depth steps": "depth is of another sensor than a Kinect, Xtion, Astra or Structure sensor, or in another unit: "
    "{detail}",
    "depth range": "{detail}: is the depth scale right (source.reader.depth_scale)?",
    "colour beside depth": "Depth seems not to be registered to colour: edges of both agree better with depth "
    "{detail}. Surfaces alone place frames. Record depth registered (aligned) to colour, or give the images of one "
    "camera and one moment.",
    "colour paired anew": "Colour was of another moment than depth: each depth image is paired anew with the colour of "
    "{detail}, which lies on it. Mend the stamps or the pairs of images.",
    "colour of another moment": "Colour seems to be of another moment than depth: that of {detail} lies on it better. "
    "Surfaces alone place frames. Mend the stamps or the pairs of images.",
    "focal length": "The camera's intrinsics are probably wrong: what frames saw of each other fits a focal length of "
    "{detail} (source.reader.camera, or the file it is read from).",
    "scan unit": "{detail}",
    "sweeps in map": "The sweeps seem to be in map coordinates: the middle of their points moves by {detail}, yet they "
    "fit each other as they are. Give them in the scanner's axes, as it measured them.",
    "other scale": "The true path is {detail} times as large as this one: depth is read in the wrong unit (--set "
    "source.reader.depth_scale), or with another camera's focal length, or the truth is not in metres, or not of the "
    "camera.",
    "truth convention": "{detail}",
    "truth clock": "{detail}: shift them in its file",
    "single frame": "{detail}: has a single frame: there is nothing to register, the model is that frame alone",
}
"""What may be wrong with the input: the sentence of each kind of note; `{count}` and `{detail}` are the note's, and of
`{count:is|are}` the side that suits the count."""
DOUBTS = {
    "ambiguous": "{count} of {detail} pairs {count:fits|fit} in several ways, as in a bare room, and "
    "{count:joins|join} nothing: take scans in between, with furniture or targets in sight.",
    "none joined": "No two are joined: {detail}.",
    "camera or object": "Objects that move, or colour and depth of two moments or views, may bend the path: in {count} "
    "of {detail}, more than a quarter of the image moves otherwise than the camera is said to. Leave these frames out, "
    "or see that each depth image has the colour of its moment, and is registered to it.",
    "unheld": "The path may slide: at {count} of {detail} what both frames see, such as a bare wall, does not hold "
    "the camera in every direction, and no other edge tests the step.",
    "path scaled": "The refined path is {detail} times as large as the one given: depth and the given poses are of "
    "two scales, or depth is warped, and nothing here tells which is right.",
    "given unlike": "The poses given are off by {detail} times the registered motion (median), more than still ones "
    "would be, and no other convention explains them: are they of this camera, of these frames, and on their clock?",
    "truth unlike": "The true poses are off by {detail} times the registered motion (median), more than still ones "
    "would be, and no other convention or clock explains them: are they of this camera, and of these frames?",
    "mostly untested": "{count} of {detail}.",
    "frames outside": "{count} of {detail} frames are from before the first given pose or after the last one: are they "
    "of another clock, or another path?",
    "path loose": "The length of the path is in doubt: {count} of {detail} sweeps {count:tells|tell} little of how "
    "far the scanner went, as on a bare field or along a bare corridor: it goes on as before there, or slides. A wider "
    "field of view, or known positions (positions.path), would hold it.",
    "not placed": "{detail}",
    "unsettled": "The result is not to be trusted: the last round still moved the cameras by {detail}, so the "
    "registered pairs do not agree on one scene. Frames nearer to each other, or more texture, would help.",
    "parts": "The viewing graph falls into {count} parts that nothing connects: their poses relative to each other "
    "mean nothing.",
}
"""What puts the result in doubt."""
LOOKS = {
    "recording incomplete": "{count} {count:file|files} of the recording {count:is|are} cut off or damaged: the "
    "reader's notes tell what was read",
    "option unknown": "{detail}; made by another version: it is left out of what is shown",
    "other units": "{detail}",
    "one frame": "the scans fit each other where they lie, as scans do that were registered before: they stay in that "
    "frame, and free space, which needs the place of each scanner, tests no pair",
    "mirrored": "scan {detail} seems mirrored, and is left apart: its reflection fits the scans around it clearly "
    "better (an axis of the wrong sign, or a left-handed frame?)",
    "not a video": "{count} frames are numbered, and nothing tells how many make a second: each is registered, "
    "and none tracked. Set start.whole_up_to=1 if they are a video",
    "tracking lost": "tracking was lost at {count} {count:frame|frames} ({detail}): {count:its pose is|their poses "
    "are} guessed from {count:its|their} neighbours'",
    "no colour": "{count} of {detail} frames with depth {count:has|have} no colour image: surfaces alone place "
    "{count:it|them}",
    "no pose near": "the trajectory beside the {count} {count:frame|frames} has no pose near in time of any: is it of "
    "another clock?",
    "no cloud": "{count} {count:frame gives|frames give} no cloud, and {count:joins|join} nothing by surfaces; the "
    "first: {detail}",
    "images unread": "{count} {count:frame has an image|frames have images} that cannot be read {detail}",
    "repeated images": "{count} {count:frame repeats|frames repeat} the images of the frame before ({detail}), as "
    "where a camera stalls: {count:its pose is|their poses are} guessed from {count:its|their} neighbours'",
    "blank images": "{count} {count:frame has|frames have} depth, but a colour image that shows nothing, black or of "
    "one even colour ({detail}): surfaces alone place them",
    "moving objects": "much of {count} {count:frame|frames} moved otherwise than the camera ({detail}): people or "
    "objects that move? The camera's motion is the one that fits more of the image; key frames leave out what moves",
    "no clock": "stamps follow each other in {detail} ms, as no camera's images do: frames are taken as evenly spaced",
    "other readout": "the read-out (rolling shutter) is taken as {detail}, not as the camera's own, with which "
    "landmarks fit worse: are the images turned, or played backwards?",
    "clock": "the clock goes back at {detail}: the step there counts as long as the usual one",
    "holes": "the recording stops for {detail}: what the frames on both sides share tells the motion there",
    "path broken": "tracking was lost for good in {count} {count:place|places}: the tracked path is in "
    "{detail} pieces, which pairs registered later may join",
    "slid": "odometry slid unnoticed at {count} {count:frame|frames} ({detail}): the pairs over these steps agree on "
    "where they lead, and count in its place",
    "sweeps left out": "{count} {count:sweep is|sweeps are} left out, and posed by neighbours where these are known; "
    "the first: {detail}",
    "sweeps loose": "{count} of {detail} sweeps {count:tells|tell} little of how far the scanner went, as in a "
    "tunnel, and it goes on as before there, or slides",
    "sweeps uneven": "the path jumps at {count} {count:sweep|sweeps}, farther off the motion of the sweeps around "
    "{count:it|them} than these are ({detail}): its steps there may be off by as much, as where objects move or points "
    "have no times",
    "sweeps untimed": "the points of the sweeps have no times (t, time, timestamp): each is taken as measured in an "
    "instant, and unless it was deskewed before (KITTI's are), turns bend the path",
    "times backwards": "the times of points seem to run backwards: taken so, more points lie on the map; they are "
    "taken so in {count} of {detail} sweeps",
    "times unused": "the points of the sweeps have times, but more lie on the map where these are unused, as of sweeps "
    "that were deskewed before: so they are in {count} of {detail} sweeps",
    "misfits": "{count} {count:frame fits|frames fit} nothing that the key frame saw ({detail}), and "
    "{count:follows|follow} its pose",
    "no truth near": "{detail}: no pose has a true one near in time: its error is not measured",
    "carried": "{count} {count:frame|frames} without a given pose {count:is|are} carried from the nearest ones by "
    "odometry",
    "left apart": "nothing joins what tracking left apart: it starts where the guessed motion puts it",
    "positions rejected": "{count} known {count:position is|positions are} rejected: the others contradict "
    "{count:it|them} by more than 5 sigma: {detail}",
    "positions scatter": "Known positions scatter {detail} times as far as their sigma says: a clock that is off, or "
    "an antenna away from the sensor (positions.antenna_m), looks like that.",
    "no decomposition": "{detail}",
    "damaged step": "{detail}: the step is computed again",
    "without images": "without images: {detail}",
    "edit lost": "edits without effect, since the last round has no such edge: {detail}",
    "edit rejected": "{detail}",
    "nothing held out": "no overlapping pair was left to judge the result by: only the edges' own chi2 does",
    "rougher": "the steps from key frame to key frame are rougher than those given: from those that images show they "
    "are {detail}",
    "untested": "{count} of {detail}",
    "given jumps": "The path given jumps at {count} {count:step|steps} ({detail}): the refined one has no such "
    "{count:step|steps}.",
    "other format": "poses are not written back into {detail}: refined.tum holds them",
    "alone": "{count} of {detail} {count:has|have} no edge at all: {count:its pose is|their poses are} not measured, "
    "in the files of poses too, where {count:it|they} may lie far from the others.",
    "wrong": "{count} of the edges used {count:is|are} judged wrong, {detail}: hodge diagnose shows them.",
    "untestable": "{count} of {detail} edges {count:is|are} untestable: nothing in the graph says whether {count:it "
    "is|they are} right.",
    "unmatched": "{detail} of each other.",
    "no metres": "There is no depth that tells the scale: lengths are in the model's own unit.",
}
"""What needs a look."""
FACTS = {
    "reader": "{detail}",
    "scale": "{detail}",
    "clouds": "{detail}",
    "start": "{detail}",
    "measured": "{detail}",
    "solver": "{detail}",
    "fuser": "{detail}",
    "recording": "{detail}",
    "refinement": "{detail}",
    "given poses": "{count} of {detail} poses given",
    "given file": "{detail}",
    "key frames": "{count} of {detail} frames {count:is a key frame|are key frames}: {count:this is|these are} "
    "registered, the others move as those around them",
    "readout": "the camera's read-out (rolling shutter), estimated: {detail}; readout_s in the camera's file would be "
    "exact",
    "truth": "{count} of {detail} frames {count:has|have} a true pose, by the truth that was named",
    "times by order": "points of {count} of {detail} sweeps have no times (t, time, timestamp), but the order in which "
    "a scanner measured them: their times are told by it",
    "revisits": "{count} {count:pair closes|pairs close} loops along the path, before the first round: odometry's "
    "poses move by up to {detail}",
    "positions of no frame": "{count} of {detail} known positions {count:is|are} of no frame, or another is nearer to "
    "theirs in time.",
    "world": "The result is in the world of {count} known positions, east, north, up: its zero is {detail}.",
    "left out": "{detail}: {count} {count:edge|edges} that the diagnosis calls wrong or suspect {count:is|are} left "
    "out of the solve",
    "matched": "{count} {count:pair|pairs} between pieces matched, {detail}",
    "suggested": "{detail}",
    "scores of before": "the scores are not measured again after an edit: hodge run, as before, measures them",
    "fused key frames": "fused after an edit: the {count} key {count:frame|frames} alone; hodge run, as before, fuses "
    "all frames",
    "edited": "edited by hand: {detail}",
    "guard": "{detail}",
    "held out": "{count} overlapping {count:pair was|pairs were} kept out of the solve: clouds there {detail}",
    "edges ignored": "The solver ignored {count} of {detail} edges (weight 0).",
    "harmless": "{count} of the edges used {count:is|are} judged wrong, {detail}: nothing to do.",
    "suspect": "{count} of the edges used {count:is|are} suspect: hodge diagnose shows them.",
    "above truth": "The clouds lie closer together at the result than at the true poses: a score measures how well "
    "clouds fit, and the noise of depth, or an error of the truth, moves the best fit away from it. Errors of the "
    "trajectory do not depend on that.",
    "edges far off": "At least {count} {count:edge|edges} that the solver used {count:is|are} more than {detail} off "
    "the result: see the worst edges.",
    "not in the error": "{detail}: {count} without a true pose, or joined to no other, {count:is|are} not in the "
    "error.",
    "degenerate": "{detail}: its positions lie on a line (or are fewer than three): its orientations aligned it.",
}
"""What only informs; the first eight are what stages report in their own words."""
WORDING = {
    kind: (rank, text)
    for rank, texts in ((Rank.INPUT, INPUTS), (Rank.DOUBT, DOUBTS), (Rank.LOOK, LOOKS), (Rank.FACT, FACTS))
    for kind, text in texts.items()
}
"""Each kind's rank, and its sentence."""


class _Count(int):
    """A number whose format `frame has|frames have` is the side that suits it."""

    def __format__(self, words: str) -> str:
        return suiting(self, words) if words else super().__format__(words)


@dataclass(frozen=True)
class Note:
    """A fact of a run: its kind (see `WORDING`), how many things it concerns and a detail; `str` gives the sentence."""

    kind: str
    count: int = 1
    detail: str = ""

    def __post_init__(self) -> None:
        if self.kind not in WORDING:
            raise ValueError(f"'{self.kind}' is no kind of note: use {', '.join(WORDING)}")

    def __str__(self) -> str:
        return WORDING[self.kind][1].format(count=_Count(self.count), detail=self.detail)

    @property
    def rank(self) -> Rank:
        """How grave it is."""
        return WORDING[self.kind][0]


def notes_of(kind: str, details: Iterable[str]) -> tuple[Note, ...]:
    """A note of one kind for each detail, a sentence of a stage."""
    return tuple(Note(kind, detail=detail) for detail in details)
