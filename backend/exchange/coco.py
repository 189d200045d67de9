"""COCO-like JSON: the bottom face as a canvas, the contact patch as an annotation on it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from touchdown.backend.annotations import Dataset, Label, Pair, content_hash
from touchdown.backend.core import FloatArray, InputError, parse_json
from touchdown.backend.exchange.exports import ExportJob
from touchdown.backend.exchange.label_import import ImportedLabel, label_file
from touchdown.backend.exchange.query import SelectedEpisode
from touchdown.backend.geometry import overlap_polygon, rotated

FILE = "annotations.json"
PX_PER_MM = 20.0
MARGIN_MM = 12.0
VISIBLE = 2
DECIMALS = 4
MIN_IOU = 0.99
EDGE_MM = 0.05  # one px: rounding of a polygon moves its edge by up to this
INK, PAPER = 60, 245


def write(job: ExportJob, folder: Path) -> Mapping[str, object]:
    """Write ``annotations.json`` and one image per pair into ``folder``."""
    images, annotations = [], []
    canvases: dict[str, Canvas] = {}
    for one in job.chosen:
        name = one.revision.geometry
        if name not in canvases:
            canvases[name] = Canvas(job.dataset.geometry.pair(name))
            canvases[name].draw(folder / _file_name(name))
        canvas = canvases[name]
        images.append(_image(one, canvas))
        annotations.append(_annotation(one, canvas))
        job.advance(one.index + 1)
    selected = content_hash([[o.entry.uuid, o.revision.rev_uuid] for o in job.chosen])
    info = {"description": "contact patches", "px_per_mm": PX_PER_MM, "revisions_sha256": selected,
            "origin_px": {name: list(c.origin_px) for name, c in canvases.items()}}  # fmt: skip
    categories = [{"id": 1, "name": "contact", "supercategory": "patch",
                   "keypoints": ["offset", "com"], "skeleton": []}]  # fmt: skip
    content = {"info": info, "images": images, "annotations": annotations, "categories": categories}
    (folder / FILE).write_text(json.dumps(content, ensure_ascii=False), "utf-8")
    return {"data": "json", "px_per_mm": PX_PER_MM}


class Canvas:
    """Transform between mm in the bottom frame and pixels of an image of face and bottom."""

    def __init__(self, pair: Pair) -> None:
        self.pair = pair
        x_mm, y_mm = (extent + MARGIN_MM for extent in pair.bottom.half_extents_mm)
        half = (math.ceil(x_mm * PX_PER_MM), math.ceil(y_mm * PX_PER_MM))
        self.origin_px = half
        self.width, self.height = 2 * half[0] + 1, 2 * half[1] + 1

    def px(self, points_mm: FloatArray) -> FloatArray:
        """Return points (n, 2) of the bottom frame in px."""
        flipped = points_mm * np.array([1.0, -1.0]) * PX_PER_MM
        centred = flipped + np.array(self.origin_px, dtype=np.float64)
        return np.asarray(np.round(centred, DECIMALS), dtype=np.float64)

    def draw(self, path: Path) -> None:
        """Draw the outline of the bottom."""
        picture = np.full((self.height, self.width), PAPER, dtype=np.uint8)
        corners = np.rint(self.px(self.pair.bottom.polygon())).astype(np.int32)
        cv2.polylines(picture, [corners], isClosed=True, color=INK, thickness=2)
        path.parent.mkdir(exist_ok=True)
        done, data = cv2.imencode(".png", picture)
        assert done
        path.write_bytes(data.tobytes())


def _file_name(pair: str) -> str:
    return f"images/{pair[:16]}.png"


def _image(one: SelectedEpisode, canvas: Canvas) -> dict[str, object]:
    return {
        "id": one.index + 1,
        "file_name": _file_name(one.revision.geometry),
        "width": canvas.width,
        "height": canvas.height,
        "episode": one.entry.uuid,
        "file_sha256": one.entry.sha256,
        "pair": one.revision.geometry,
        "split": one.split,
    }


def _annotation(one: SelectedEpisode, canvas: Canvas) -> dict[str, object]:
    revision, pair = one.revision, canvas.pair
    offset = revision.label.offset_mm
    yaw_rad = math.radians((revision.label.theta_mdeg or 0) / 1e3)
    x_mm, y_mm = offset.tolist()
    patch_mm = overlap_polygon(pair.face, (x_mm, y_mm), pair.bottom, yaw_rad)
    centre_mm = offset + rotated(np.array(pair.centre_mm), yaw_rad)
    points = [
        value
        for xy in canvas.px(np.stack([offset, centre_mm])).tolist()
        for value in (*xy, VISIBLE)
    ]
    return {
        "id": one.index + 1,
        "image_id": one.index + 1,
        "category_id": 1,
        **_shape(canvas.px(patch_mm)),
        "iscrowd": 0,
        "keypoints": points,
        "num_keypoints": 2,
        "rev_uuid": revision.rev_uuid,
        "source": revision.source,
        "state": revision.state,
        "label": asdict(revision.label),
    }


def _shape(polygon_px: FloatArray) -> dict[str, object]:
    if not len(polygon_px):
        return {"segmentation": [], "bbox": [0, 0, 0, 0], "area": 0.0}
    low, high = polygon_px.min(axis=0), polygon_px.max(axis=0)
    x, y = polygon_px[:, 0], polygon_px[:, 1]
    area = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
    box = np.round([*low, *(high - low)], DECIMALS)
    return {
        "segmentation": [polygon_px.reshape(-1).tolist()],
        "bbox": box.tolist(),
        "area": round(area, DECIMALS),
    }


def read_coco(source: Path, dataset: Dataset) -> Iterator[ImportedLabel]:
    """Yield the offsets of ``annotations.json``; rows whose polygon does not fit carry a warning.

    Raises ``InputError`` if the file is damaged or foreign.
    """
    path = label_file(source, FILE)
    try:
        content = parse_json(path.read_bytes())
        origins, scale = content["info"]["origin_px"], float(content["info"]["px_per_mm"])
        images = {image["id"]: image for image in content["images"]}
        for annotation in content["annotations"]:
            image = images[annotation["image_id"]]
            origin = np.array(origins[image["pair"]], dtype=np.float64).reshape(2)
            yield _row(annotation, image, partial(_to_mm, origin, scale), dataset)
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else error
        raise InputError(
            f"The annotations cannot be read: {why}.", str(path), "Export them again."
        ) from error


def _to_mm(origin_px: FloatArray, px_per_mm: float, points_px: Any) -> FloatArray:
    """Return points (n, 2) in mm in the bottom frame."""
    points = np.array(points_px, dtype=np.float64).reshape(-1, 2)
    return np.asarray((points - origin_px) / px_per_mm * np.array([1.0, -1.0]))


def _row(
    annotation: Mapping[str, Any],
    image: Mapping[str, Any],
    to_mm: Callable[[Any], FloatArray],
    dataset: Dataset,
) -> ImportedLabel:
    x_mm, y_mm = to_mm(annotation["keypoints"][:2])[0].tolist()
    x_um, y_um = round(x_mm * 1e3), round(y_mm * 1e3)
    was = Label(**annotation["label"]) if "label" in annotation else None
    moved = was is None or (was.x_um, was.y_um) != (x_um, y_um)
    theta_mdeg = None if was is None else was.theta_mdeg
    # the uncertainty of a moved label is unknown
    label = Label(x_um, y_um, theta_mdeg, None if moved or was is None else was.sigma_um)
    warning = ""
    if annotation["segmentation"]:
        pair = dataset.geometry.pair(str(image["pair"]))
        corners = to_mm(annotation["segmentation"][0])
        share = _iou(corners, label, pair, dataset)
        if share < MIN_IOU:
            warning = f"its polygon and the patch of its offset overlap by {share:.2f} only"
    return ImportedLabel(str(image["episode"]), str(image.get("file_sha256", "")), label, warning)


def _iou(corners_mm: FloatArray, label: Label, pair: Pair, dataset: Dataset) -> float:
    """Return the overlap of the points within a convex polygon with the derived patch."""
    touching = dataset.geometry.patch(pair.sha256, label).touching
    yaw_rad = math.radians((label.theta_mdeg or 0) / 1e3)
    points = rotated(pair.points_mm, yaw_rad) + label.offset_mm
    along = np.roll(corners_mm, -1, axis=0) - corners_mm
    x, y = corners_mm[:, 0], corners_mm[:, 1]
    turn = 1.0 if float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) > 0.0 else -1.0
    away = points[:, None, :] - corners_mm
    cross = turn * (along[:, 0] * away[..., 1] - along[:, 1] * away[..., 0])
    depth_mm = (cross / np.maximum(np.hypot(along[:, 0], along[:, 1]), EDGE_MM)).min(axis=1)
    # Rounding of the corners may move the edge, so points near it are not compared.
    drawn = np.where(np.abs(depth_mm) < EDGE_MM, touching, depth_mm > 0.0)
    union = int((drawn | touching).sum())
    return int((drawn & touching).sum()) / union if union else 1.0
