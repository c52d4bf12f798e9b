"""Depth, colour and angle of incidence of a room as an ideal camera sees them, by ray casting."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.demo.room import Room
from hodge_pipeline.lean_open3d import o3d
from hodge_pipeline.types import Camera, Floats, Floats32, Ints

HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""open3d sends the ray of pixel (0, 0) through (0.5, 0.5); in `Camera` the centres of pixels are whole numbers."""
SHADOW_GAP_M = 0.01
"""From a surface to where its shadow ray starts, so that it does not shade itself."""
AMBIENT, SKYLIGHT, LAMPLIGHT = 0.42, 0.16, 0.62
"""Light from everywhere, from the window and from the lamp, as shares of a white surface's brightness."""
BLUR_SAMPLES, EDGE = 7, cv2.BORDER_REPLICATE
"""Samples along the way of a pixel while the shutter is open, a few pixels long, and what lies beyond the image."""


@dataclass(frozen=True)
class Hits:
    """What the rays of an image hit first, for the P pixels that hit anything.

    `pixel (P,)` flat pixel numbers; `depth_m (P,)` along the optical axis; `points_in_room (P, 3)`; unit
    `normals (P, 3)` towards the camera; `facing (P,)` the cosine between normal and ray; `part (P,)` rows of the room.
    """

    pixel: Ints
    depth_m: Floats32
    points_in_room: Floats
    normals: Floats
    facing: Floats
    part: Ints


class Renderer:
    """Renders one room with one camera, at one pose (4, 4) or at a pose (H, 4, 4) of each row of the image."""

    def __init__(self, room: Room, camera: Camera) -> None:
        self.room, self.camera = room, camera
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(room.vertices.astype(np.float32)),
            o3d.core.Tensor.from_numpy(room.triangles.astype(np.uint32)),
        )

    def depth(self, world_from_cam: Floats) -> tuple[Floats32, Floats32]:
        """Depth (H, W) in metres, 0 where a depth camera sees nothing, and the cosine of incidence (H, W)."""
        hits = self._cast(world_from_cam)
        seen = self.room.measurable[hits.part]
        shape = (self.camera.height, self.camera.width)
        depth_m, facing = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        depth_m.ravel()[hits.pixel[seen]] = hits.depth_m[seen]
        facing.ravel()[hits.pixel] = hits.facing
        return depth_m, facing

    def colour(self, world_from_cam: Floats, moved: Floats | None = None) -> Floats32:
        """The lit image (H, W, 3), RGB in 0..1; blurred where a twist `moved (6,)` in the camera's axes is given.

        The twist is the motion of the camera while its shutter is open.
        """
        hits = self._cast(world_from_cam)
        room, image = self.room, np.zeros((self.camera.height * self.camera.width, 3), np.float32)
        albedo = self._texture(hits) * room.tint[hits.part]
        glow = room.glow[hits.part][:, None]
        image[hits.pixel] = albedo * (glow + (1 - glow) * self._light(hits)[:, None])
        whole = np.clip(image, 0, 1).reshape(self.camera.height, self.camera.width, 3)
        return whole if moved is None else self._blurred(whole, hits, moved)

    def _blurred(self, image: Floats32, hits: Hits, moved: Floats) -> Floats32:
        """The mean of the image along the way of each pixel, which the twist and the pixel's depth give."""
        camera, row, column = self.camera, *np.divmod(hits.pixel, self.camera.width)
        slope_x, slope_y = (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy
        slopes = np.stack([slope_x, slope_y, np.ones(len(row))], axis=1)
        way = -(np.cross(moved[:3], slopes) + moved[3:] / hits.depth_m[:, None])
        ways = np.zeros((2, camera.height * camera.width), np.float32)
        ways[:, hits.pixel] = ((way[:, :2] - slopes[:, :2] * way[:, 2:]) * [camera.fx, camera.fy]).T
        across, down = ways.reshape(2, camera.height, camera.width)
        v, u = np.indices(across.shape, np.float32)
        shares = (np.arange(BLUR_SAMPLES, dtype=np.float32) + 0.5) / BLUR_SAMPLES - 0.5
        seen = [
            cv2.remap(image, u + share * across, v + share * down, cv2.INTER_LINEAR, borderMode=EDGE)
            for share in shares
        ]
        return np.asarray(np.mean(seen, axis=0), np.float32)

    def _cast(self, world_from_cam: Floats) -> Hits:
        """The hits of an image at a pose (4, 4), or at a pose (H, 4, 4) of each row."""
        rays = self._rays(world_from_cam)
        found = self._scene.cast_rays(rays)
        depth_m = found["t_hit"].numpy().ravel()
        pixel = np.flatnonzero(np.isfinite(depth_m))
        direction = rays.numpy().reshape(-1, 6)[pixel, 3:].astype(float)
        triangle = found["primitive_ids"].numpy().ravel()[pixel].astype(np.int64)
        normals = self._normals(triangle, found["primitive_uvs"].numpy().reshape(-1, 2)[pixel])
        facing = -np.einsum("ij,ij->i", normals, direction) / np.linalg.norm(direction, axis=1)
        normals *= np.sign(facing)[:, None]
        of_rows = np.broadcast_to(world_from_cam, (self.camera.height, 4, 4))
        points = of_rows[pixel // self.camera.width, :3, 3] + depth_m[pixel, None] * direction
        return Hits(pixel, depth_m[pixel], points, normals, np.abs(facing), self.room.part_of_triangle[triangle])

    def _rays(self, world_from_cam: Floats) -> o3d.core.Tensor:
        """Origin and direction (H, W, 6) of the ray of each pixel, its direction of unit depth."""
        rolling = world_from_cam.ndim == 3
        rays = self._scene.create_rays_pinhole(
            intrinsic_matrix=o3d.core.Tensor.from_numpy(self.camera.matrix + HALF_PIXEL),
            extrinsic_matrix=o3d.core.Tensor.from_numpy(np.eye(4) if rolling else se3.inverse(world_from_cam)),
            width_px=self.camera.width,
            height_px=self.camera.height,
        )
        if not rolling:
            return rays
        directions = rays.numpy()[..., 3:] @ np.swapaxes(world_from_cam[:, :3, :3], 1, 2)
        origins = np.broadcast_to(world_from_cam[:, None, :3, 3], directions.shape)
        return o3d.core.Tensor.from_numpy(np.concatenate([origins, directions], axis=2).astype(np.float32))

    def _normals(self, triangle: Ints, uv: Floats32) -> Floats:
        """Unit normals (P, 3), interpolated between a triangle's corners so that round bodies look round."""
        corners = self.room.normals[self.room.triangles[triangle]]
        shares = np.stack([1 - uv[:, 0] - uv[:, 1], uv[:, 0], uv[:, 1]], axis=1)
        normals = np.einsum("pc,pcd->pd", shares, corners)
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def _texture(self, hits: Hits) -> Floats32:
        """Texture colours (P, 3), projected along that axis of the part that the surface faces most."""
        part_from_room = self.room.part_from_room[hits.part]
        local = np.einsum("pij,pj->pi", part_from_room[:, :3, :3], hits.points_in_room) + part_from_room[:, :3, 3]
        faces = np.abs(np.einsum("pij,pj->pi", part_from_room[:, :3, :3], hits.normals)).argmax(axis=1)
        across, up = np.array([1, 0, 0])[faces], np.array([2, 2, 1])[faces]
        row, tile_m = np.arange(len(faces)), self.room.tile_m[hits.part]
        u = local[row, across] / tile_m[row, across] + 0.5
        v = -local[row, up] / tile_m[row, up] + np.where(up == 1, 0.5, 0.0)
        pixel_m = hits.depth_m / self.camera.fx / np.sqrt(np.maximum(hits.facing, 0.05))
        footprint = pixel_m / np.minimum(tile_m[row, across], tile_m[row, up])
        return self.room.textures.sample(self.room.texture[hits.part], np.stack([u, v], axis=1), footprint)

    def _light(self, hits: Hits) -> Floats32:
        """The light (P,) on each point: ambient, skylight from the window, and lamplight, 15 % of it in shadow."""
        start = hits.points_in_room + SHADOW_GAP_M * hits.normals
        towards = self.room.lamp[hits.part] - start
        distance = np.linalg.norm(towards, axis=1)
        rays = np.concatenate([start, towards], axis=1).astype(np.float32)
        shaded = self._scene.test_occlusions(o3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=1.0).numpy()
        lambert = np.maximum(np.einsum("ij,ij->i", hits.normals, towards) / distance, 0)
        lamp = LAMPLIGHT * lambert * np.where(shaded, 0.15, 1.0) * 2.2 / (1 + 0.4 * distance**2)
        sky = SKYLIGHT * (1 - hits.normals[:, 0]) / 2 + SKYLIGHT * hits.normals[:, 2]
        return np.asarray(AMBIENT + sky + lamp, np.float32)
