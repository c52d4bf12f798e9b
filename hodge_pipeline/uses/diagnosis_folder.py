"""Write a diagnosis into a folder: table, poses, page and recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_pipeline import registry
from hodge_pipeline.diagnosis.result import CONSISTENT, Diagnosis
from hodge_pipeline.recording.diagnosis_file import write_diagnosis
from hodge_pipeline.refine.pose_graph import vertex_trajectory
from hodge_pipeline.report.diagnosis_page import PageContents, document
from hodge_pipeline.report.diagnosis_plots import draw, pieces_apart
from hodge_pipeline.report.document import render
from hodge_pipeline.report.edge_pictures import edge_pictures
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.edge_table import write_edges
from hodge_pipeline.store.workspace import EDGES_FILE, make_folder
from hodge_pipeline.types import Source
from hodge_pipeline.uses.diagnosed import Diagnosed, DiagnosisSubject

PICTURED, LEAST_PICTURED = 6, 2
"""Edges that the page shows in pictures: those that are not consistent, at most and at least so many."""


def write_diagnosed(out: Path, diagnosed: Diagnosed) -> None:
    """Write `edges.csv`, `poses.tum`, `diagnosis.html` and `diagnosis.rrd` into a folder, made if it is not there."""
    make_folder(out)
    subject, found = diagnosed.subject, diagnosed.diagnosis
    residuals = {"residual_m": found.residual_m, "residual_rad": np.deg2rad(found.residual_deg)}
    edges, names = replace(found.put_into(subject.edges), **residuals), subject.graph.vertex_ids
    write_edges(out / EDGES_FILE, edges, names, has_metres=subject.has_metres)
    _write_poses(out / "poses.tum", subject, found)
    artifacts.write_text(out / "diagnosis.html", render(document(_page(diagnosed))))
    write_diagnosis(out / "diagnosis.rrd", subject.graph, pieces_apart(found.world_from_cam, found.piece), found)


def _write_poses(path: Path, subject: DiagnosisSubject, found: Diagnosis) -> None:
    """Write the robust poses as TUM, their stamps the numbers of the vertices."""
    trajectory = vertex_trajectory(subject.graph, found.world_from_cam)
    registry.load("writers", "tum")().write(path, Source(subject.name, subject.path, trajectory=trajectory))


def _page(diagnosed: Diagnosed) -> PageContents:
    subject, found = diagnosed.subject, diagnosed.diagnosis
    rows = diagnosed.rows[: max(LEAST_PICTURED, min(PICTURED, int((found.verdict != CONSISTENT).sum())))]
    pictures = edge_pictures(subject.graph, found, rows, subject.frames, subject.clouds, has_metres=subject.has_metres)
    return PageContents(
        title=subject.name,
        graph=subject.graph,
        diagnosis=found,
        advice=diagnosed.advice,
        energy=diagnosed.energy,
        plots=tuple(draw(subject.graph, found, diagnosed.energy, subject.has_metres)),
        edges=pictures,
        suggestions=diagnosed.suggestions,
        commands=diagnosed.commands,
        notes=diagnosed.notes,
        has_metres=subject.has_metres,
    )
